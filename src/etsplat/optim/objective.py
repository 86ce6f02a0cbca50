"""What is minimised: how far pictures are from photos, and a sum of weighted terms.

    L = photometric + scale * sum_k weight_k value_k ^ power_k

A step sees one view or more. Each view is drawn, compared and differentiated by itself; what looks at pictures counts
with the mean over the views, what looks at parameters alone counts once.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar, Literal

import torch
from jaxtyping import Float, Int, UInt8
from torch import Tensor

from etsplat.core.cameras import Cameras
from etsplat.core.rasterization import OUTPUTS, Rasterization
from etsplat.core.validation import check_choice, check_kind, check_number, shown
from etsplat.model.model import Depth
from etsplat.ops.weighted_sum import Term as Summand
from etsplat.ops.weighted_sum import weighted_sum
from etsplat.optim.schedules import Scheduled, at


@dataclass(frozen=True, eq=False)
class Drawing:
    """One view of a step: what terms look at.

    Attributes:
        model: as it is now.
        camera: of the view.
        photo: (1, H, W, 3 or 4), bytes or floats in [0, 1]; four channels are premultiplied.
        mask: (1, H, W) bytes, 255 where pixels count, or None.
        background: (1, 3) behind the picture, and to be put behind the photo.
        rendering: the picture, as the photo was exposed, with the outputs that the terms ask for.
        shared: what one term has computed of this view for others, by its name.
        index: (1,) of the view in its data set.
        depth: (1, H, W) along the optical axis, in units of the model's frame, 0 where not known; None without.

    Example:
        A term on its own, of a drawing that is made by hand:

        >>> mesh = etsplat.TriangleMesh.from_mesh(*etsplat.icosphere(1), colors=1.0, opacity=0.98, sigma=0.25)
        >>> camera, black = etsplat.orbit_cameras(16, 16)[0], torch.zeros(1, 3)
        >>> drawing = etsplat.Drawing(mesh, camera, torch.zeros(1, 16, 16, 3), None, black, mesh.render(camera))
        >>> 0 < etsplat.Photometric()(drawing).item() < 1
        True
    """

    model: Any
    camera: Cameras
    photo: UInt8[Tensor, "1 H W C"] | Float[Tensor, "1 H W C"]
    mask: UInt8[Tensor, "1 H W"] | None
    background: Float[Tensor, "1 3"]
    rendering: Rasterization
    shared: dict[Hashable, Any] = field(default_factory=dict)
    index: Int[Tensor, "1"] | None = None
    depth: Float[Tensor, "1 H W"] | None = None


class _NotGivenError(AttributeError):
    """What a term looks at, and is not given."""


@dataclass(frozen=True)
class OfParameters:
    """What terms look at that depend on the parameters alone.

    Attributes:
        model: as it is now.
        shared: what one term has computed for others, by its name.
    """

    model: Any
    shared: dict[Hashable, Any] = field(default_factory=dict)

    def __getattr__(self, name: str) -> Any:
        raise _NotGivenError(
            f"looks at drawing.{name}; without outputs it counts once for all views of a step, and is given "
            "drawing.model alone where there are several: name what it looks at, as etsplat.Custom(function, "
            'outputs=("color",))'
        )


class Term(ABC):
    """One summand: weight * value ^ power. A term of one's own overrides `__call__`, or is made by `Custom`.

    Attributes:
        name: what settings call it: `lambda_NAME` is its weight. None for a term without a setting.
        weight: a number, or a function of the iteration; at 0 the term is not computed. On a device a new weight
            captures the steps anew, so what changes at every step belongs into the objective's `scale`.
        outputs: what it needs of `etsplat.rasterize`; nothing for a term that depends on the parameters alone.
        power: of the value.
        looks_at: what it looks at, if that is parameters alone, or colours of pictures alone: workers of a run then
            need not send each other what they can compute for themselves. None for more, or where nobody says.
        squares: name of the parameter of whose rows it is the mean sum of squares: its gradient is a multiple of that
            parameter, which the optimizer can add by itself. None for any other term.

    Example:
        >>> class Centred(etsplat.Term):
        ...     def __call__(self, drawing):
        ...         return drawing.model.vertices.mean(dim=0).square().sum()
        >>> Centred(weight=0.1).weight
        0.1
    """

    name: ClassVar[str | None] = None
    weight: Scheduled = 1.0
    outputs: tuple[str, ...] = ()
    power: Literal[1, -1, -2] = 1
    looks_at: ClassVar[Literal["parameters", "colors"] | None] = None
    squares: ClassVar[str | None] = None

    def __init__(self, weight: Scheduled = 1.0) -> None:
        """Takes its weight. Raises ValueError where that is neither a number nor a function."""
        if not callable(weight):
            check_number("weight", weight)
        self.weight = weight

    def __repr__(self) -> str:
        return f"{type(self).__name__}({_named(self.weight)})"

    @abstractmethod
    def __call__(self, drawing: Drawing) -> Float[Tensor, ""]:
        """The value, differentiable."""


class Custom(Term):
    """A term of one's own from a function of the drawing; without `outputs` it counts once for all views of a step.

    Example:
        >>> def flat(drawing):
        ...     return drawing.rendering.depth.diff(dim=1).abs().mean()
        >>> term = etsplat.Custom(flat, 0.01, outputs=("depth",))
        >>> objective = etsplat.Objective(etsplat.Photometric(dssim=0.2), [term])
    """

    def __init__(
        self,
        value: Callable[[Drawing], Float[Tensor, ""]],
        weight: Scheduled = 1.0,
        *,
        outputs: str | Sequence[str] = (),
    ) -> None:
        """Takes them.

        Raises:
            ValueError: `value` is no function, the weight neither a number nor one, or there is no such output.
        """
        super().__init__(weight)
        if not callable(value):
            raise ValueError(f"value must be a function of a drawing, got {shown(value)}")
        self._value, self.outputs = value, (outputs,) if isinstance(outputs, str) else tuple(outputs)
        for name in self.outputs:
            check_choice("outputs", name, OUTPUTS)

    def __repr__(self) -> str:
        name = getattr(self._value, "__name__", type(self._value).__name__)
        outputs = f", outputs={self.outputs}" if self.outputs else ""
        return f"{type(self).__name__}({name}, {_named(self.weight)}{outputs})"

    def __call__(self, drawing: Drawing) -> Float[Tensor, ""]:
        """Of the function."""
        return self._value(drawing)


class Objective:
    """A photometric term and others.

    Attributes:
        photometric: compares pictures with photos; its weight is 1.
        terms: the others, added in their order.
        scale: of all others together: a number, or a function of the iteration.
        depth_of: where depths of the outputs are measured: on a triangle's "plane" or at its "centroid".

    Example:
        >>> terms = [etsplat.EdgeLength(0.5), etsplat.Laplacian(0.2)]
        >>> objective = etsplat.Objective(etsplat.Photometric(), terms, scale=lambda iteration: 0.99**iteration)
        >>> [term.weight for term in objective.terms]
        [0.5, 0.2]
    """

    def __init__(
        self, photometric: Term, terms: Sequence[Term] = (), *, scale: Scheduled = 1.0, depth_of: Depth = "plane"
    ) -> None:
        """Takes them.

        Raises:
            ValueError: one of them is no `Term`, or asks for outputs that there are not.
        """
        if isinstance(terms, Term):
            raise ValueError(f"terms must be a sequence of terms, got {type(terms).__name__}: pass [term]")
        self.photometric, self.terms, self.scale = photometric, tuple(terms), scale
        for name, term in (("photometric", photometric), *((f"terms[{k}]", t) for k, t in enumerate(self.terms))):
            function = callable(term) and not isinstance(term, type)
            check_kind(name, term, Term, "etsplat.Custom(function) makes one" if function else "make one")
            check_asked(name, term.outputs)
        self.depth_of: Depth = depth_of

    def __repr__(self) -> str:
        terms = [repr(self.photometric), *map(repr, self.terms)]
        return f"{type(self).__name__}({' + '.join(terms)}, scale={_named(self.scale)})"

    def weights(self, iteration: int) -> tuple[float, ...]:
        """Of the terms. Raises ValueError where a function of the iteration returns no number."""
        found = tuple(at(term.weight, iteration) for term in self.terms)
        for number, weight in enumerate(found):
            check_number(f"the weight of terms[{number}] of the objective at iteration {iteration}", weight)
        return found

    def outputs(self, weights: Sequence[float]) -> tuple[str, ...]:
        """What pictures must hold for the terms that count."""
        counting = [self.photometric, *(term for term, weight in zip(self.terms, weights, strict=True) if weight)]
        return tuple(dict.fromkeys(name for term in counting for name in term.outputs))

    def __call__(
        self,
        drawing: Drawing,
        weights: Sequence[float],
        scale: float | Float[Tensor, ""],
        *,
        views: int = 1,
        whole: bool = True,
        apart: bool = False,
        decayed: bool = False,
    ) -> Float[Tensor, ""]:
        """The part of a step's objective that belongs to one of its views.

        Args:
            drawing: the view.
            weights: of the terms, as of `weights`.
            scale: of them all; at the number 0 they are not computed.
            views: how many the step has.
            whole: whether terms that depend on the parameters alone belong to this view.
            apart: whether those count with their values alone, and `of_parameters` has their gradients.
            decayed: whether sums of squares count with their values alone, and `decays` has their gradients.

        Raises:
            ValueError: a term is no scalar tensor of the model's dtype and device.
        """
        first = _value_of("photometric", self.photometric, drawing)
        given = drawing if views == 1 else OfParameters(drawing.model, drawing.shared)  # not one view for all of them
        if views > 1:
            first = first / views
        if not isinstance(scale, Tensor) and scale == 0.0:
            return first
        summands = []
        for number, (term, weight) in enumerate(zip(self.terms, weights, strict=True)):
            if weight and (whole or term.outputs):
                elsewhere = (apart and not term.outputs) or (decayed and term.squares is not None)
                with torch.set_grad_enabled(torch.is_grad_enabled() and not elsewhere):
                    value = _value_of(f"terms[{number}]", term, drawing if term.outputs else given, first)
                summands.append(Summand(weight / views if term.outputs else weight, value, term.power))
        return weighted_sum(first, summands, scale)

    def separable(self, weights: Sequence[float]) -> bool:
        """Whether terms that count look at parameters alone, and the photometric one at colours alone.

        Then a view's picture gives each parameter one gradient, to which that of the others can be added in any place.
        """
        counting = [term for term, weight in zip(self.terms, weights, strict=True) if weight]
        return self.photometric.looks_at == "colors" and all(term.looks_at == "parameters" for term in counting)

    def decays(self, model: Any, weights: Sequence[float], scale: float) -> dict[str, float]:
        """By name of a parameter, how many times it is the gradient of the terms that are sums of its squares.

        Args:
            model: as it is now.
            weights: of the terms, as of `weights`.
            scale: of them all.
        """
        found: dict[str, float] = {}
        for term, weight in zip(self.terms, weights, strict=True):
            if term.squares is not None and weight and scale:
                parameter = model.parameters()[term.squares]
                one = torch.ones((), dtype=parameter.dtype)  # rounded as autograd rounds it
                share = float(one * scale * weight / len(parameter) * 2)
                found[term.squares] = found.get(term.squares, 0.0) + share
        return found

    def of_parameters(
        self, model: Any, weights: Sequence[float], scale: float, *, decayed: bool = False
    ) -> Float[Tensor, ""] | None:
        """The part of a step's objective that depends on the parameters alone; None where nothing does.

        Args:
            model: as it is now.
            weights: of the terms, as of `weights`.
            scale: of them all.
            decayed: whether sums of squares are left out, as `decays` has their gradients.

        Raises:
            ValueError: a term is no scalar tensor.
        """
        counting = enumerate(zip(self.terms, weights, strict=True))
        here = [(number, *each) for number, each in counting if not (decayed and each[0].squares)]
        alone = [(number, term, weight) for number, term, weight in here if weight and not term.outputs]
        if not alone or scale == 0.0:
            return None
        drawing = OfParameters(model)
        summands = [
            Summand(weight, _value_of(f"terms[{number}]", term, drawing), term.power) for number, term, weight in alone
        ]
        return weighted_sum(torch.zeros_like(summands[0].value), summands, scale)


def check_asked(name: str, outputs: Sequence[str]) -> None:
    """Raises ValueError where a part of a run asks for outputs that there are not, or by one word."""
    if isinstance(outputs, str):
        raise ValueError(f"{name}.outputs must be a sequence of names, got {outputs!r}: make it a tuple")
    for output in outputs:
        check_choice(f"{name}.outputs", output, OUTPUTS)


def _named(weight: Scheduled) -> str:
    """A number, or the name of a function of the iteration."""
    return getattr(weight, "__name__", type(weight).__name__) if callable(weight) else f"{weight:.3g}"


def _value_of(name: str, term: Term, drawing: Any, like: Tensor | None = None) -> Float[Tensor, ""]:
    """What a term returns. ValueError where that is no scalar tensor, or one unlike the others."""
    who = f"{name} of the objective, {type(term).__name__},"
    try:
        value = term(drawing)
    except _NotGivenError as error:
        raise ValueError(f"{who} {error}") from None
    except (AttributeError, TypeError) as error:
        if not isinstance(drawing, Drawing) or "NoneType" not in str(error):
            raise
        lacking = [output for output in OUTPUTS if getattr(drawing.rendering, output, None) is None]
        raise ValueError(
            f"{who} ended with: {error}. Its outputs are {term.outputs}; drawing.rendering has no "
            f"{', '.join(lacking)} where they do not name these"
        ) from error
    if isinstance(value, Tensor) and value.ndim == 0:
        if like is None or (value.dtype == like.dtype and value.device == like.device):
            _check_learns(who, term, value, drawing)
            return value
        got = f"{value.dtype} on {value.device}, where photometric has {like.dtype} on {like.device}"
    else:
        got = shown(value)
    raise ValueError(f"{who} must return a scalar tensor of the model's dtype and device, got {got}")


def _check_learns(who: str, term: Term, value: Tensor, drawing: Any) -> None:
    """ValueError where a value changes nothing though what it is of is learned; not of 0, as where nothing is known."""
    if value.requires_grad or not torch.is_grad_enabled():
        return
    if value.is_cuda and torch.cuda.is_current_stream_capturing():  # its value is not known then
        return
    if term.outputs:
        looked_at = [getattr(drawing.rendering, name) for name in term.outputs]
    else:
        looked_at = drawing.model.parameters().values()
    if value != 0 and any(isinstance(tensor, Tensor) and tensor.requires_grad for tensor in looked_at):
        raise ValueError(
            f"{who} has no gradient and so changes nothing: compute it by torch from drawing.model or"
            " drawing.rendering, without detach(), item(), numpy or comparisons alone"
        )
