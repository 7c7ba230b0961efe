"""Models of motion and measurement; each submodule is loaded when it is first named."""

from torchfilt.lazy import lazy_names

__all__ = ["attitude", "control", "inertial", "ode", "relative_motion", "sensors"]

__getattr__, __dir__ = lazy_names(__name__, dict.fromkeys(__all__, ""), globals())
