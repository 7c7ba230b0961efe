"""Models of motion and measurement; each submodule is loaded when it is first named."""

from importlib import import_module
from types import ModuleType

__all__ = ["ode", "relative_motion"]


def __getattr__(name: str) -> ModuleType:
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return import_module(f"{__name__}.{name}")


def __dir__() -> list[str]:
    return sorted([*globals(), *__all__])
