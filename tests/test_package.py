"""The package as a whole: what an import costs and touches, which way its arrows point, what it must never call."""

import ast
import importlib
import os
import statistics
import subprocess
import sys
import tomllib
from graphlib import TopologicalSorter
from pathlib import Path

import pytest

import torchfilt

ROOT = Path(torchfilt.__file__).parent
REPOSITORY = Path(__file__).parents[1]


def name_of(path):
    parts = ("torchfilt", *path.relative_to(ROOT).with_suffix("").parts)
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


TREES = {name_of(path): ast.parse(path.read_text(), str(path)) for path in sorted(ROOT.rglob("*.py"))}
modules = pytest.mark.parametrize("module", TREES)


def imports(tree, outside_functions=False):
    """Modules of the package that a file imports, with those inside its functions unless told otherwise."""
    nodes = ast.walk(tree)
    if outside_functions:
        inner = (ast.FunctionDef, ast.AsyncFunctionDef)
        hidden = {id(n) for f in ast.walk(tree) if isinstance(f, inner) for n in ast.walk(f)}
        nodes = (node for node in ast.walk(tree) if id(node) not in hidden)
    for node in nodes:
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names if alias.name.split(".")[0] == "torchfilt")
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, "imports are written in full"
            if node.module.split(".")[0] == "torchfilt":
                for alias in node.names:
                    full = f"{node.module}.{alias.name}"
                    yield full if full in TREES else node.module


# Arrows -------------------------------------------------------------------------------------------------------------

# From the bottom up. A file imports what lies below it, and within its own folder. What stands on one line stands side
# by side and knows nothing of its neighbours.
LAYERS = [
    ["lazy", "linalg", "quaternions", "storage"],
    ["spaces"],
    ["gaussian", "particles", "noise"],
    ["types", "exact"],
    ["moments", "resampling", "laws", "history"],
    ["symmetry", "gates", "mixture"],
    ["model", "gp", "recording", "kernels", "sensors"],
    ["proposals", "moves", "models"],
    ["run", "rao_blackwell"],
    ["filters"],
    ["smoothing", "robust", "delays", "modes", "metrics"],
    ["learning", "report", "io", "testing"],
    ["missions"],
]
LEVEL = {part: level for level, parts in enumerate(LAYERS) for part in parts}


def part_of(module):
    return module.split(".")[1]


@modules
def test_arrows_point_one_way(module):
    if module == "torchfilt":
        return  # the front door names everything
    part = part_of(module)
    assert part in LEVEL, f"{module} has no layer yet: give it one in LAYERS"
    for target in imports(TREES[module]):
        if target == "torchfilt":
            assert part in LAYERS[-1], f"{module} imports the front door, which stands above it"
            continue
        other = part_of(target)
        assert other == part or LEVEL[other] < LEVEL[part], f"{module} imports {target}, which is not below it"


@modules
def test_laws_do_not_know_filters(module):
    """Models and Gaussian processes are laws: usable without any filter of ours."""
    if module.startswith(("torchfilt.models", "torchfilt.gp")):
        above = {"run", "filters", "proposals", "moves", "smoothing", "learning"}
        assert not {part_of(target) for target in imports(TREES[module])} & above


def test_no_circle_of_imports():
    graph = {module: set(imports(tree, outside_functions=True)) - {module} for module, tree in TREES.items()}
    list(TopologicalSorter(graph).static_order())  # raises CycleError with the circle


@modules
def test_the_library_does_not_import_its_surroundings(module):
    """Nothing of tests, scripts or benchmarks."""
    outside = {path.stem for path in REPOSITORY.iterdir()} - {"torchfilt"}
    for node in ast.walk(TREES[module]):
        names = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
        names += [node.module] if isinstance(node, ast.ImportFrom) and node.module else []
        assert not {name.split(".")[0] for name in names} & outside


# State that belongs to the user -------------------------------------------------------------------------------------

FORBIDDEN = {
    "set_default_dtype",
    "set_default_device",
    "set_default_tensor_type",
    "set_num_threads",
    "set_num_interop_threads",
    "set_rng_state",
    "set_printoptions",
    "set_float32_matmul_precision",
    "use_deterministic_algorithms",
    "seed_everything",
}
# Allowed where the state is put back at the end of the block.
IN_BLOCK = {"manual_seed": "fork_rng", "simplefilter": "catch_warnings", "filterwarnings": "catch_warnings"}
GENERATORS = {"torch", "torch.random", "torch.cuda", "random", "np.random", "numpy.random"}


def calls(node, blocks=()):
    """Each call as (dotted name, enclosing `with` items)."""
    if isinstance(node, ast.With):
        blocks = (*blocks, *(ast.unparse(item.context_expr) for item in node.items))
    if isinstance(node, ast.Call) and isinstance(node.func, ast.Name | ast.Attribute):
        yield ast.unparse(node.func), blocks
    for child in ast.iter_child_nodes(node):
        yield from calls(child, blocks)


def offences(tree):
    for name, blocks in calls(tree):
        owner, _, last = name.rpartition(".")
        if last in FORBIDDEN or (last in {"seed", "manual_seed_all"} and owner in GENERATORS):
            yield name
        elif last in IN_BLOCK and (last != "manual_seed" or owner in GENERATORS):
            if not any(IN_BLOCK[last] in block for block in blocks):
                yield name


@modules
def test_the_library_never_sets_global_state(module):
    assert not list(offences(TREES[module]))


def test_the_search_for_global_state_finds_it():
    """The test above can fail: each line is an offence, or is none."""
    bad = ["torch.set_num_threads(1)", "torch.manual_seed(0)", "np.random.seed(1)", "warnings.simplefilter('ignore')"]
    assert [list(offences(ast.parse(line))) for line in bad] == [[line.split("(")[0]] for line in bad]
    good = ["torch.Generator().manual_seed(0)", "with torch.random.fork_rng():\n    torch.manual_seed(0)"]
    assert not any(list(offences(ast.parse(line))) for line in good)
    assert list(imports(ast.parse("def f():\n    from torchfilt.filters import x"))) == ["torchfilt.filters"]
    assert not list(imports(ast.parse("def f():\n    import torchfilt.run"), outside_functions=True))


# The import ---------------------------------------------------------------------------------------------------------


def run(program):
    environment = os.environ | {"OMP_NUM_THREADS": "1"}
    return subprocess.run(
        [sys.executable, "-c", program], env=environment, capture_output=True, text=True, check=True
    ).stdout.strip()


HEAVY = ["gpytorch", "linear_operator", "pytorch_lightning", "lightning_fabric", "matplotlib", "scipy", "roma"]
HEAVY += ["torch._dynamo", "sympy", "xarray", "pandas", "h5py", "brahe", "jsonargparse"]

FIRST_IMPORT = f"""
import sys, warnings
import torch
def state():
    return (torch.get_default_dtype(), torch.get_num_threads(), torch.is_grad_enabled(), list(warnings.filters),
            torch.get_rng_state().tolist())
before = state()
already = {{name for name in {HEAVY} if name in sys.modules}}
import torchfilt
assert state() == before, "the import changed global state"
print(sorted(name for name in {HEAVY} if name in sys.modules and name not in already))
"""


def test_an_import_loads_nothing_heavy_and_touches_nothing():
    assert run(FIRST_IMPORT) == "[]"


@pytest.mark.slow
def test_an_import_takes_a_fifth_of_a_second_more_than_torch():
    """The median of seven processes."""
    program = "import time, torch\nstart = time.perf_counter()\nimport torchfilt\nprint(time.perf_counter() - start)"
    assert statistics.median(float(run(program)) for _ in range(7)) < 0.2


# Names --------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", torchfilt.__all__)
def test_every_public_name_is_there_and_documented(name):
    value = getattr(torchfilt, name)
    documented = value.__doc__ or ""
    assert documented.strip() and not documented.startswith(f"{name}("), "a tuple's own signature is no documentation"
    assert name in dir(torchfilt)


@modules
def test_every_public_definition_is_documented(module):
    tree = TREES[module]
    assert ast.get_docstring(tree), f"{module} has no docstring"
    kinds = (ast.FunctionDef, ast.AsyncFunctionDef, ast.ClassDef)
    bare = [n.name for n in tree.body if isinstance(n, kinds) and n.name[0] != "_" and not ast.get_docstring(n)]
    assert not bare


def test_an_unknown_name_is_an_error():
    with pytest.raises(AttributeError, match="module 'torchfilt' has no attribute 'KalmannFilter'"):
        importlib.import_module("torchfilt").KalmannFilter  # noqa: B018


def test_types_are_shipped():
    assert (ROOT / "py.typed").is_file()
    project = tomllib.loads((REPOSITORY / "pyproject.toml").read_text())
    assert "py.typed" in project["tool"]["setuptools"]["package-data"]["torchfilt"]
    assert project["project"]["version"] == torchfilt.__version__
