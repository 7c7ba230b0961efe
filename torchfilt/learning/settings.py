"""Settings of a training run by script: plain values, completed and checked before anything is computed."""

import importlib.util
from dataclasses import asdict, dataclass, fields, replace
from typing import Any, Literal

SIMULATED = ("cloud", "arcs", "trajectory")
Nominal = Literal["two-body", "ltv", "cw", "none"]
# Acceleration noise (m^2/s^3) that covers what the learned residual leaves in each nominal law.
_PSD = {"two-body": 1e-15, "ltv": 1e-15, "cw": 1e-13}
_ARCS = 10


class UsageError(ValueError):
    """Options that make no sense together, or would destroy something."""


@dataclass(frozen=True)
class RunSettings:
    """Options of `run_training`; None stands for a default that depends on the others.

    Attributes:
        source: "cloud", "arcs", "trajectory" (simulated formation) or the path of an NPZ file.
        samples: training pairs; None: 500 simulated ones, or all of a file.
        dt: time step, s; None: what the file says, else 10.
        held_out: share of a file's rows, its last ones, kept for testing.
        test: another NPZ file to test on.
        seed: of data, subset and minibatches.
        phase_column: column of a file's u that holds the phase, rad; None: u is a chief-orbit control.
        control_columns: columns of u that the GP gets as inputs (squared-exponential kernels).
        nominal: known dynamics. mean_motion: of "cw", rad/s; None: from the chief's orbit.
        target, kernel, phase, shared, standardize, noise_floor, inducing, optimizer, epochs, learning_rate, batch_size,
            hyperparameter_samples: see `train_transition`.
        psd: acceleration noise of the nominal law, m^2/s^3.
        device: "cpu", "cuda" or "cuda:N". dtype: of the learned law; training is in double precision.
        out: run folder. resume: go on from its checkpoint. force: overwrite it.
        figures, tensorboard: what to write besides.
    """

    source: str = "cloud"
    samples: int | None = None
    dt: float | None = None
    held_out: float = 0.2
    test: str | None = None
    seed: int = 0
    phase_column: int | None = None
    control_columns: tuple[int, ...] = ()
    nominal: Nominal | None = None
    mean_motion: float | None = None
    target: Literal["residual", "identity", "next_state"] | None = None
    kernel: Literal["structured", "ard", "isotropic"] | None = None
    phase: bool = True
    shared: bool = False
    standardize: bool = True
    noise_floor: float | None = None
    psd: float | None = None
    inducing: int | None = None
    optimizer: Literal["lbfgs", "adam"] | None = None
    epochs: int | None = None
    learning_rate: float = 0.02
    batch_size: int | None = None
    hyperparameter_samples: int = 250
    device: str = "cpu"
    dtype: Literal["float64", "float32"] = "float64"
    out: str = "runs/gp"
    resume: bool = False
    force: bool = False
    figures: bool = True
    tensorboard: bool = False

    @property
    def simulated(self) -> bool:
        """Whether the data are simulated."""
        return self.source in SIMULATED

    @property
    def step(self) -> float:
        """Time step of resolved settings, s."""
        if self.dt is None:
            raise ValueError("the time step is not resolved yet")
        return self.dt

    @property
    def groups(self) -> int:
        """Number of trajectories that simulated pairs come from, where there are several."""
        return _ARCS

    def to_dict(self) -> dict[str, Any]:
        """What describes the run, JSON-ready: all but the requests to resume and to overwrite."""
        kept = {name: value for name, value in asdict(self).items() if name not in ("resume", "force")}
        return {**kept, "control_columns": list(self.control_columns)}


def resolve(settings: RunSettings, controls: int | None, state: int, dt: float | None) -> RunSettings:
    """Fill in the defaults and check that the options fit each other and the data.

    Args:
        settings: as given.
        controls: columns of u, None without u.
        state: columns of x.
        dt: step that the data themselves name, s.

    Raises:
        UsageError: the rule and the values that break it.
    """
    check_numbers(settings)
    s = replace(settings, control_columns=tuple(settings.control_columns))
    orbital = controls == 21 and state == 6
    nominal = s.nominal or ("two-body" if orbital and s.target in (None, "residual") else "none")
    target = s.target or ("identity" if nominal == "none" else "residual")
    if (target == "residual") != (nominal != "none"):
        raise UsageError(
            f"--target {target} with --nominal {nominal}: a residual needs a nominal law, the other targets take none"
        )
    if nominal in ("two-body", "ltv") and not orbital:
        raise UsageError(
            f"--nominal {nominal} needs states x (S, 6) and chief-orbit controls u (S, 21); "
            f"{s.source} has {state} and {controls or 'no'} columns"
        )
    if nominal == "cw" and (state != 6 or not (orbital or s.mean_motion)):
        raise UsageError(
            f"--nominal cw needs states x (S, 6), and the chief's orbit in u (S, 21) or --mean-motion; {s.source} has "
            f"{state} and {controls or 'no'} columns"
        )
    if s.mean_motion is not None and nominal != "cw":
        raise UsageError(f"--mean-motion belongs to --nominal cw, not {nominal}")
    if s.psd is not None and nominal == "none":
        raise UsageError("--psd is the noise of a nominal law, and --nominal is none")
    if s.phase and s.phase_column is None and not orbital:
        raise UsageError(
            f"{s.source} has no chief-orbit controls u (S, 21) for the phase: give --phase-column or --phase false"
        )
    for column in (*s.control_columns, *([] if s.phase_column is None else [s.phase_column])):
        if not 0 <= column < (controls or 0):
            raise UsageError(f"column {column} of u is asked for, and u has {controls or 0} columns")
    kernel = s.kernel or ("structured" if s.phase and s.inducing is None and not s.control_columns else "ard")
    if kernel == "structured" and (not s.phase or s.control_columns or s.inducing):
        raise UsageError("--kernel structured takes the phase alone: no --control-columns, --phase false or --inducing")
    if dt is not None and s.dt is not None and abs(dt - s.dt) > 1e-9 * dt:
        raise UsageError(f"--dt {s.dt:g}: the file's own step is {dt:g} s")
    optimizer = s.optimizer or ("lbfgs" if s.inducing is None else "adam")
    if s.inducing is not None and optimizer == "lbfgs":
        raise UsageError("--inducing trains on minibatches, which need --optimizer adam")
    if s.batch_size is not None and s.inducing is None:
        raise UsageError("--batch-size is for the sparse GP (--inducing); the exact one takes all pairs at once")
    return replace(
        s,
        samples=s.samples if s.samples is not None else (500 if s.simulated else None),
        dt=s.dt if s.dt is not None else (dt if dt is not None else 10.0),
        nominal=nominal,
        target=target,
        kernel=kernel,
        noise_floor=s.noise_floor if s.noise_floor is not None else (1e-5 if s.inducing is None else 1e-4),
        psd=s.psd if s.psd is not None else _PSD.get(nominal),
        optimizer=optimizer,
        epochs=s.epochs if s.epochs is not None else (20 if optimizer == "lbfgs" else 300),
    )


def check_numbers(s: RunSettings) -> None:
    """Ranges of single options."""
    least: dict[str, float] = {"samples": 2, "epochs": 1, "batch_size": 1, "inducing": 1, "hyperparameter_samples": 2}
    for name, bound in least.items():
        value = getattr(s, name)
        if value is not None and value < bound:
            raise UsageError(f"{option(name)} must be at least {bound}, got {value}")
    for name in ("dt", "noise_floor", "learning_rate", "mean_motion"):
        value = getattr(s, name)
        if value is not None and not 0 < value < float("inf"):
            raise UsageError(f"{option(name)} must be positive and finite, got {value}")
    if s.psd is not None and not 0 <= s.psd < float("inf"):
        raise UsageError(f"--psd must be finite and not negative, got {s.psd}")
    if not 0 < s.held_out < 1 and not (s.held_out == 0 and s.test):
        raise UsageError(f"--held-out must lie between 0 and 1 (or be 0 with --test), got {s.held_out}")
    if not 0 <= s.seed < 2**31:
        raise UsageError(f"--seed must be between 0 and 2147483647, got {s.seed}")
    if s.resume and s.force:
        raise UsageError("--resume goes on with a run and --force overwrites it: give one of them")
    if s.simulated and (s.test is not None or s.phase_column is not None):
        raise UsageError(f"--test and --phase-column go with an NPZ file, and --source is {s.source}")
    if s.source == "arcs" and s.samples is not None and s.samples % s.groups:
        raise UsageError(f"--samples must be a multiple of {s.groups} for arcs, got {s.samples}")
    if s.tensorboard and not any(importlib.util.find_spec(name) for name in ("tensorboard", "tensorboardX")):
        raise UsageError("--tensorboard needs the package tensorboardX or tensorboard, and neither is installed")


def different(stored: dict[str, Any], own: dict[str, Any]) -> str | None:
    """First option of ``own`` that would make another run than ``stored``, in words; None where they agree."""
    free = {"out", "figures", "tensorboard", "epochs"}
    for field in fields(RunSettings):
        name = field.name
        if name in own and name not in free and stored.get(name) != own[name]:
            return f"{option(name)} was {stored.get(name)} and is now {own[name]}"
    return None


def option(name: str) -> str:
    """Command-line spelling."""
    return "--" + name.replace("_", "-")
