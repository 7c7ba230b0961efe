"""Sensors that come and go, and constraints: several measurement laws side by side, NaN where one is silent."""

from collections.abc import Callable, Iterable, Iterator, Mapping
from itertools import accumulate, pairwise
from typing import Any

import torch
from torch import Tensor, nn

from torchfilt.gaussian import Gaussian, cat_columns
from torchfilt.laws import LinearForm, call_style, check_finite, hold
from torchfilt.linalg import for_points
from torchfilt.spaces import EUCLIDEAN, Euclidean, Product, Space

Law = Callable[..., Any]
Step = Tensor | float | None


class PseudoMeasurement(nn.Module):
    """A constraint ``h(x) = value`` as a measurement that is always there: ``value ~ N(h(x), diag(sd^2))``.

    Soft where sd > 0: each use counts as information, a measurement with independent errors at each step. Exact where
    sd is zero from the start and no parameter: for Gaussian filters and for particles that carry covariances; a point
    meets an exact constraint with probability zero, so that filters of points fail on it.

    An exact one that holds already, because nothing has moved the state off it or because others imply it, counts as
    not measured: its predicted deviation is below 128 eps of the terms that it is the sum of. Where another value is
    given there, the row fails with a log-likelihood of -inf, and a member of a bank or a mixture has no weight. Motion
    keeps a constraint only if its noise does: give that by ``scale_tril``, a covariance's root has zeros to sqrt(eps).
    A curved constraint holds once the linearisations about it agree, and until then counts at each use. Laws beside an
    exact constraint must have forward derivatives, and no gradient goes through a covariance that it made singular.
    A gate does not refuse a contradiction.

    A part of `Sensors`, whose `Sensors.pack` and `Sensors.complete` write ``value`` into the measurement.

    Args:
        function: h, batched over leading dims; takes x (..., d) and, by name or in this order, u and dt. Or a matrix
            (size, d) as a tensor: then it is linear and a `torchfilt.KalmanFilter` takes it.
        size: numbers in h(x).
        sd: standard deviations, a number or (size,), zero or more; a parameter trains.
        value: a number or (size,).
        jacobian: derivative of h by the tangent of the state, called like h, gives (..., size, e); or None.

    Raises:
        TypeError: function is neither callable nor a tensor.
        ValueError: shapes that do not fit size, a negative sd, numbers that are not finite, a jacobian beside a matrix;
            when called, a function that gives another shape.

    Source: Simon, Kalman filtering with state constraints, IET Control Theory Appl. 4 (2010), section 2.
    """

    sd: Tensor
    value: Tensor
    exact: tuple[int, ...]
    matrix: Tensor
    linear_form: Callable[..., LinearForm]
    first_order: Callable[..., tuple[Gaussian, Tensor]]

    def __init__(
        self,
        function: Callable[..., Tensor] | Tensor,
        size: int,
        sd: Tensor | float,
        value: Tensor | float = 0.0,
        *,
        jacobian: Callable[..., Tensor] | None = None,
    ) -> None:
        super().__init__()
        if size < 1:
            raise ValueError(f"size must be at least 1, got {size}")
        self.size, self.space = size, EUCLIDEAN
        for name, given in (("sd", sd), ("value", value)):
            hold(self, name, _vector(given, size, name))
        if (self.sd.detach() < 0).any():
            raise ValueError(f"sd must not be negative, got {self.sd.detach().min().item()}")
        if not self.sd.requires_grad:
            zero = (self.sd == 0).nonzero().squeeze(-1).tolist()
            if zero:
                self.exact = tuple(zero)
        self.function: Callable[..., Tensor] | None = None
        if isinstance(function, Tensor):
            if function.dim() != 2 or len(function) != size:
                raise ValueError(f"a matrix must be ({size}, d), got {tuple(function.shape)}")
            if jacobian is not None:
                raise ValueError("a matrix is its own jacobian, give one of the two")
            check_finite(function, "matrix")
            hold(self, "matrix", function)
            self.linear_form = self._linear_form
            return
        if not callable(function):
            raise TypeError(f"function must be callable or a matrix as a tensor, got {type(function).__name__}")
        self.function, self.style = function, call_style(function)
        self.jacobian = jacobian
        if jacobian is not None:
            self.jacobian_style = call_style(jacobian)
            self.first_order = self._first_order

    @property
    def takes_controls(self) -> bool:
        """Whether the function looks at u."""
        return self.function is not None and self.style.takes_u

    def forward(self, x: Tensor, u: Tensor | None = None, dt: Step = None) -> Gaussian:
        """Law of the value given x (..., d)."""
        mean = x @ self.matrix.mT if self.function is None else self.style.call(self.function, x, u, dt)
        if mean.shape != (*x.shape[:-1], self.size):
            raise ValueError(
                f"function must turn x {tuple(x.shape)} into (*lead, {self.size}), got {tuple(mean.shape)}"
            )
        return Gaussian(mean, self.sd.to(mean.dtype), is_diagonal=True)

    def _linear_form(self, u: Tensor | None = None, dt: Step = None) -> LinearForm:
        return LinearForm(self.matrix, None, torch.diag_embed(self.sd.to(self.matrix.dtype)))

    def _first_order(self, x: Tensor, u: Tensor | None = None, dt: Step = None) -> tuple[Gaussian, Tensor]:
        assert self.jacobian is not None
        return self(x, u, dt), self.jacobian_style.call(self.jacobian, x, u, dt)


class Sensors(nn.Module):
    """Measurement law made of several: a measurement is theirs side by side, NaN where a sensor is silent.

    The space is Euclidean where all of theirs are, else their product, so that angles wrap. The noise factor is
    diagonal where all of theirs are, else block-diagonal; it has no particle axis as long as none of theirs has one.
    `linear_form` and `first_order` are offered where each law offers one of them, `linear_in` where all that are not
    linear agree on it.

    A law may name by ``exact`` the components of its error that have no noise by construction; theirs are joined.
    A law may say by ``in_view(x) -> bool (...)`` from which states it sees anything: see `hide`.

    Args:
        laws: by name, in the order of the measurement; a mapping, keywords, or both. A law states its ``size`` (numbers
            in a measurement), or a ``space`` with a size, or a ``matrix``; one whose errors have another number of
            components, as those of quaternions, states its ``space``.

    Attributes:
        names, sizes: of the sensors, in order.
        columns: one slice a sensor into a measurement (..., size).
        parts: one slice a sensor into the error of a measurement (..., tangent_size).

    Raises:
        TypeError: a law is not callable; when called, one that gives anything but a `Gaussian`.
        ValueError: no sensor, a name that is given twice, is no identifier or that `torch.nn.ModuleDict` keeps for
            itself, a law that does not state its size; when called, one that gives another size than it states.
    """

    linear_form: Callable[..., LinearForm]
    first_order: Callable[..., tuple[Gaussian, Tensor]]
    linear_in: slice | tuple[int, ...]
    exact: tuple[int, ...]

    def __init__(self, laws: Mapping[str, Law] | None = None, /, **more: Law) -> None:
        super().__init__()
        twice = sorted(set(laws or {}) & set(more))
        if twice:
            raise ValueError(f"sensor {twice[0]!r} is given twice")
        given = {**(laws or {}), **more}
        if not given:
            raise ValueError("Sensors needs at least one law")
        self.laws = nn.ModuleDict()
        self._functions: dict[str, Law] = {}
        for name, law in given.items():
            self._add(name, law)
        self.names = tuple(given)
        self.sizes = tuple(_size_of(name, law) for name, law in given.items())
        self._spaces = tuple(_space_of(law, size) for law, size in zip(given.values(), self.sizes, strict=True))
        tangent = [space.tangent_size or 0 for space in self._spaces]
        self.columns, self.parts = _slices(self.sizes), _slices(tangent)
        self.size, self.tangent_size = sum(self.sizes), sum(tangent)
        self.space = _joint(self._spaces)
        self._styles = tuple(call_style(law) for law in given.values())
        self._offer(list(given.values()))

    def _add(self, name: str, law: Law) -> None:
        if not isinstance(name, str) or not name.isidentifier():
            raise ValueError(f"a sensor's name must be an identifier, such as barometer, got {name!r}")
        if not callable(law):
            raise TypeError(f"sensor {name!r} must be a law, called as law(x), got {type(law).__name__}")
        if not isinstance(law, nn.Module):
            self._functions[name] = law
        elif hasattr(self.laws, name):
            raise ValueError(f"{name!r} can't name a sensor: torch.nn.ModuleDict keeps it for itself")
        else:
            self.laws[name] = law

    def _offer(self, laws: list[Law]) -> None:
        """Short cuts, as attributes: whoever asks for one that is not offered finds none."""
        linear = [hasattr(law, "linear_form") for law in laws]
        if all(linear):
            self.linear_form = self._linear_form
        if all(known or hasattr(law, "first_order") for law, known in zip(laws, linear, strict=True)):
            self.first_order = self._first_order
        exact = [part.start + k for law, part in zip(laws, self.parts, strict=True) for k in getattr(law, "exact", ())]
        if exact:
            self.exact = tuple(exact)
        declared = [getattr(law, "linear_in", None) for law, known in zip(laws, linear, strict=True) if not known]
        if declared and declared[0] is not None and all(one == declared[0] for one in declared):
            self.linear_in = declared[0]

    def law(self, name: str) -> Law:
        """The law of one sensor.

        Raises:
            ValueError: there is no such sensor.
        """
        self._check_names([name])
        return self._functions[name] if name in self._functions else self.laws[name]

    def _laws(self) -> Iterator[Law]:
        return (self._functions[n] if n in self._functions else self.laws[n] for n in self.names)

    @property
    def takes_controls(self) -> bool:
        """Whether a law looks at u."""
        pairs = zip(self._laws(), self._styles, strict=True)
        return any(getattr(law, "takes_controls", style.takes_u) for law, style in pairs)

    def forward(self, x: Tensor, u: Tensor | None = None, dt: Step = None) -> Gaussian:
        """Law of the whole measurement given x (..., d)."""
        return self._join([style.call(law, x, u, dt) for law, style in zip(self._laws(), self._styles, strict=True)])

    def _join(self, found: list[Gaussian]) -> Gaussian:
        """Side by side; what stands in all of them without a particle axis stays without."""
        for k, part in enumerate(found):
            self._check_part(k, part)
        mean = _side_by_side([part.mean for part in found])
        space = self.space
        if not all(_same(part.space, stated) for part, stated in zip(found, self._spaces, strict=True)):
            space = _joint(_sized(part.space, size) for part, size in zip(found, self.sizes, strict=True))
        if all(part.is_diagonal for part in found):
            return Gaussian(mean, _side_by_side([part.scale_tril for part in found]), space, True)
        return Gaussian(mean, _block_diagonal([part.factor() for part in found]), space)

    def _check_part(self, k: int, part: Gaussian) -> None:
        if not isinstance(part, Gaussian):
            raise TypeError(
                f"sensor {self.names[k]!r} gives a {type(part).__name__}; sensors side by side must give a Gaussian"
            )
        stated, own = self.parts[k].stop - self.parts[k].start, part.tangent_size
        if part.mean.shape[-1] != self.sizes[k] or own != stated:
            raise ValueError(
                f"sensor {self.names[k]!r} states {self.sizes[k]} numbers with {stated} errors, it gives "
                f"{part.mean.shape[-1]} numbers with {own} errors on {part.space!r}; let it state its space"
            )

    def _linear_form(self, u: Tensor | None = None, dt: Step = None) -> LinearForm:
        forms = [getattr(law, "linear_form")(u, dt) for law in self._laws()]  # noqa: B009 (a law is any callable)
        offset = None
        if any(form.offset is not None for form in forms):
            zero = [form.matrix.new_zeros(form.matrix.shape[-2]) for form in forms]
            pairs = zip(forms, zero, strict=True)
            offset = _side_by_side([none if form.offset is None else form.offset for form, none in pairs])
        matrix = cat_columns(*(form.matrix.mT for form in forms)).mT
        return LinearForm(matrix, offset, _block_diagonal([form.scale_tril for form in forms]))

    def _first_order(self, x: Tensor, u: Tensor | None = None, dt: Step = None) -> tuple[Gaussian, Tensor]:
        found, slopes = [], []
        for law, style in zip(self._laws(), self._styles, strict=True):
            own = getattr(law, "first_order", None)
            if own is not None:
                at, slope = own(x, u, dt)
            else:
                at = style.call(law, x, u, dt)
                slope = for_points(getattr(law, "linear_form")(u, dt).matrix, 2, x.dim() - 1)  # noqa: B009
            found.append(at)
            slopes.append(slope.mT)
        return self._join(found), cat_columns(*slopes).mT

    # ------------------------------------------------------------------------------------------------------------------
    # Measurements

    def pack(
        self,
        named: Mapping[str, Tensor | None],
        lead: tuple[int, ...] | None = None,
        like: Tensor | None = None,
    ) -> Tensor:
        """One tensor of what the sensors named say, NaN where the others are silent.

        Pseudo-measurements write their value by themselves; None leaves one out, a tensor takes the place of its value.

        Args:
            named: (*lead, m_i) by name, or None; all with the same number of leading dims, which broadcast: (*batch)
                for one step, (t, *batch) for a series. NaN stays what it is: not measured.
            lead: leading dims of the result, default those of the tensors.
            like: a tensor of the dtype wanted, such as the belief's mean; default the first of the tensors.

        Returns:
            (*lead, size).

        Raises:
            TypeError: not a mapping, something that is not a tensor, another dtype.
            ValueError: a name that no sensor has, another size, leading dims that do not fit, nothing that tells lead
                and dtype.
        """
        if not isinstance(named, Mapping):
            raise TypeError(f"measurements must be a tensor or a mapping by sensor, got {type(named).__name__}")
        self._check_names(named)
        present = {name: value for name, value in named.items() if value is not None}
        like = next(iter(present.values()), None) if like is None else like
        if like is None or (lead is None and not present):
            raise ValueError("no sensor says anything: give lead= and like=, the leading dims and the dtype")
        for name, value in present.items():
            _check_value(name, value, self.sizes[self.names.index(name)], like)
        lead = _common_lead({name: value.shape[:-1] for name, value in present.items()}, lead)
        blocks = []
        for name, size, law in zip(self.names, self.sizes, self._laws(), strict=True):
            if name in present:
                block = present[name]
            elif isinstance(law, PseudoMeasurement) and name not in named:
                block = law.value.to(like)
            else:
                block = like.new_full((size,), torch.nan)
            blocks.append(block.expand(*lead, size))
        return torch.cat(blocks, -1)

    def unpack(self, y: Tensor) -> dict[str, Tensor]:
        """Each sensor's share (..., m_i) of measurements y (..., size), by name.

        Raises:
            ValueError: y has another size.
        """
        self._check_measurement(y)
        return {name: y[..., column] for name, column in zip(self.names, self.columns, strict=True)}

    def complete(self, y: Tensor) -> Tensor:
        """Measurements y (..., size) with the values of pseudo-measurements in the place of their NaNs.

        Raises:
            ValueError: y has another size.
        """
        shares = self.unpack(y)
        for name, law in zip(self.names, self._laws(), strict=True):
            if isinstance(law, PseudoMeasurement):
                shares[name] = torch.where(torch.isnan(shares[name]), law.value.to(y), shares[name])
        return torch.cat(list(shares.values()), -1)

    def hide(self, y: Tensor, x: Tensor) -> Tensor:
        """Measurements y (*lead, size) with NaN for each sensor that can't see from states x (*lead, d).

        A law with a method ``in_view(x) -> bool (...)`` is asked; one without always sees.

        Raises:
            ValueError: y has another size.
        """
        shares = self.unpack(y)
        for name, law in zip(self.names, self._laws(), strict=True):
            in_view = getattr(law, "in_view", None)
            if in_view is not None:
                shares[name] = torch.where(in_view(x).unsqueeze(-1), shares[name], torch.nan)
        return _side_by_side(list(shares.values()))

    def drop_out(self, y: Tensor, share: float | Mapping[str, float], uniforms: Tensor) -> Tensor:
        """Measurements y (*lead, size) with NaN where a sensor fails by chance, each on its own.

        Args:
            y: measurements.
            share: probability of a failure: one for all sensors but pseudo-measurements, or by name.
            uniforms: (*lead, number of sensors) in [0, 1), a column a sensor.

        Raises:
            ValueError: a name that no sensor has, a probability outside [0, 1], shapes that do not fit.
        """
        shares = self.unpack(y)
        if uniforms.shape != (*y.shape[:-1], len(self.names)):
            wanted = (*y.shape[:-1], len(self.names))
            raise ValueError(f"uniforms must be {wanted}, a column a sensor, got {tuple(uniforms.shape)}")
        if isinstance(share, Mapping):
            self._check_names(share)
        else:
            laws = zip(self.names, self._laws(), strict=True)
            share = {name: share for name, law in laws if not isinstance(law, PseudoMeasurement)}
        for name, chance in share.items():
            if not 0 <= chance <= 1:
                raise ValueError(f"the share of sensor {name!r} must be in [0, 1], got {chance}")
            k = self.names.index(name)
            shares[name] = torch.where(uniforms[..., k : k + 1] < chance, torch.nan, shares[name])
        return torch.cat(list(shares.values()), -1)

    def _check_names(self, names: Any) -> None:
        for name in names:
            if name not in self.names:
                raise ValueError(f"there is no sensor {name!r}; there are {', '.join(self.names)}")

    def _check_measurement(self, y: Tensor) -> None:
        if y.dim() == 0 or y.shape[-1] != self.size:
            raise ValueError(f"measurements must be (..., {self.size}), got {tuple(y.shape)}")


def _vector(given: Tensor | float, size: int, name: str) -> Tensor:
    """A number or (size,) as (size,), a parameter as it is."""
    values = given if isinstance(given, Tensor) else torch.tensor(given, dtype=torch.float64)
    if values.shape not in ((), (size,)):
        raise ValueError(f"{name} must be a number or ({size},), got {tuple(values.shape)}")
    check_finite(values, name)
    return values if values.dim() else values.expand(size)


def _size_of(name: str, law: Any) -> int:
    """Numbers in a measurement, as the law states them."""
    size = getattr(law, "size", None)
    if size is None:
        size = getattr(getattr(law, "space", None), "size", None)
    matrix = getattr(law, "matrix", None)
    if size is None and isinstance(matrix, Tensor):
        size = matrix.shape[-2]
    if not isinstance(size, int):
        raise ValueError(f"sensor {name!r}, a {type(law).__name__}, must state how many numbers it gives: set its size")
    return size


def _space_of(law: Any, size: int) -> Space:
    return _sized(getattr(law, "space", EUCLIDEAN), size)


def _sized(space: Space, size: int) -> Space:
    return Euclidean(size) if isinstance(space, Euclidean) else space


def _same(space: Space, stated: Space) -> bool:
    return space == stated or type(space) is type(stated) is Euclidean


def _joint(spaces: Iterable[Space]) -> Space:
    """Side by side, products laid open and Euclidean neighbours merged: each part left is one more operation."""
    flat: list[Space] = []
    for space in spaces:
        for part in space.spaces if isinstance(space, Product) else (space,):
            if flat and isinstance(part, Euclidean) and isinstance(flat[-1], Euclidean):
                part = Euclidean((flat.pop().size or 0) + (part.size or 0))
            flat.append(part)
    return flat[0] if len(flat) == 1 else Product(*flat)


def _slices(sizes: Any) -> tuple[slice, ...]:
    return tuple(slice(start, stop) for start, stop in pairwise(accumulate(sizes, initial=0)))


def _side_by_side(parts: list[Tensor]) -> Tensor:
    """Parts (..., k_i) as one (..., k), leading dims broadcast, component by component in memory."""
    lead = torch.broadcast_shapes(*(part.shape[:-1] for part in parts))
    return torch.cat([part.expand(*lead, -1).movedim(-1, 0) for part in parts]).movedim(0, -1)


def _block_diagonal(blocks: list[Tensor]) -> Tensor:
    """Blocks (..., e_i, e_i) down the diagonal of (..., e, e), leading dims broadcast."""
    total, start, columns = sum(block.shape[-1] for block in blocks), 0, []
    for block in blocks:
        size = block.shape[-1]
        columns.append(torch.nn.functional.pad(block, (0, 0, start, total - start - size)))
        start += size
    return cat_columns(*columns)


def _check_value(name: str, value: object, size: int, like: Tensor) -> None:
    if not isinstance(value, Tensor):
        raise TypeError(f"sensor {name!r} must be a tensor (*lead, {size}) or None, got {type(value).__name__}")
    if value.dim() == 0 or value.shape[-1] != size:
        raise ValueError(f"sensor {name!r} must be (*lead, {size}), got {tuple(value.shape)}")
    if value.dtype != like.dtype:
        raise TypeError(f"sensor {name!r} must have the dtype {like.dtype}, got {value.dtype}")


def _common_lead(leads: dict[str, torch.Size], wanted: tuple[int, ...] | None) -> tuple[int, ...]:
    """Leading dims that all broadcast to; as many dims in each, so that none lands on a dim of another meaning."""
    common = None if wanted is None else torch.Size(wanted)
    for name, lead in leads.items():
        common = lead if common is None else common
        fits = len(lead) == len(common) and all(1 in (a, b) or a == b for a, b in zip(lead, common, strict=True))
        joint = torch.broadcast_shapes(lead, common) if fits else None
        if joint is None or (wanted is not None and joint != common):
            raise ValueError(f"sensor {name!r} has leading dims {tuple(lead)}, which do not fit {tuple(common)}")
        common = joint
    assert common is not None
    return common
