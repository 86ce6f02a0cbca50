"""One target for each public operation."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, fields, is_dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch
import torch._refs  # tensors on "meta" import it when they are first used, which would be in every worker
from torch import Tensor

import etsplat
from etsplat import Adam, Cameras, MeshTopology, RowPlan
from etsplat.metrics.geometry import geometry_metrics
from etsplat.ops.pick_values import pick_values
from etsplat.ops.soup_activation import soup_activation
from etsplat.ops.soup_colors import soup_colors
from etsplat.ops.triangle_area import mean_area
from etsplat.ops.triangle_channels import triangle_channels
from etsplat.ops.weighted_sum import Term, weighted_sum
from helpers.scenes import cameras, mesh, soup
from tests.fuzz.arguments import Arguments, Odd, odd
from tests.fuzz.session import Refused


@dataclass
class Operation:
    """A function, and arguments that it takes.

    Attributes:
        name: of the target.
        function: called by names.
        make: valid arguments, in several kinds.
        least_accepted: the share of inputs that must be accepted.
    """

    name: str
    function: Callable[..., Any]
    make: Callable[[], list[Arguments]]
    least_accepted: float = 0.1

    @cached_property
    def valid(self) -> list[Arguments]:
        """Made when first asked for."""
        return self.make()

    def describe(self, rng: np.random.Generator) -> Odd:
        """The arguments of an input."""
        return odd(self.valid[int(rng.integers(len(self.valid)))], rng)

    def run(self, described: Odd, folder: Path) -> None:
        """Call it, and its gradients where there are any.

        Raises:
            Refused: by ValueError; or by TypeError, where an argument is not what the signature says.
        """
        try:
            found = self.function(**_copied(described.values))
        except ValueError as error:
            raise Refused from error
        except TypeError as error:
            if described.untyped:
                raise Refused from error
            raise
        grown = [tensor for tensor in _tensors(found) if tensor.requires_grad]
        if grown:
            torch.autograd.backward(grown, [torch.ones_like(tensor) for tensor in grown])


def _copied(values: Arguments) -> Arguments:
    """Operations may write into what they are given; odd layouts are kept where a copy would lose them."""
    return {
        name: value.detach().clone().requires_grad_(value.requires_grad)
        if isinstance(value, Tensor) and value.is_contiguous() and value.layout == torch.strided and _has_memory(value)
        else value
        for name, value in values.items()
    }


def _has_memory(tensor: Tensor) -> bool:
    return tensor.untyped_storage().nbytes() > 0 and not tensor.is_neg()


def _tensors(value: Any) -> Iterator[Tensor]:
    if isinstance(value, Tensor):
        yield value
    elif isinstance(value, tuple | list):
        for entry in value:
            yield from _tensors(entry)
    elif isinstance(value, dict):
        yield from _tensors(list(value.values()))
    elif is_dataclass(value) and not isinstance(value, type):
        yield from _tensors([getattr(value, entry.name) for entry in fields(value)])


RNG = torch.Generator().manual_seed(0)
SIZE = {"width": 20, "height": 16}


def _grown(arguments: Arguments) -> Arguments:
    floating = [v for v in arguments.values() if isinstance(v, Tensor) and v.is_floating_point()]
    for tensor in floating:
        tensor.requires_grad_()
    return arguments


def _splats() -> list[Arguments]:
    separate = {**soup(RNG, 20, **SIZE), "near_plane": 0.01, "kernel": "elastic", "distance": "barycentric"}
    shared = {**mesh(RNG, 0, **SIZE), "outputs": ("depth", "normal", "median_depth", "distortion", "statistics")}
    double = {name: v.double() if isinstance(v, Tensor) else v for name, v in soup(RNG, 4, width=6, height=5).items()}
    return [separate, shared, _grown(soup(RNG, 20, **SIZE)), _grown(double)]


def _meshes() -> Arguments:
    scene = mesh(RNG, 0, **SIZE)
    return {
        name: scene[name]
        for name in ("vertices", "faces", "viewmats", "Ks", "width", "height", "near_plane")
        if name in scene
    }


def _opaque() -> list[Arguments]:
    colors = torch.rand(20, 3, generator=RNG)
    return [{**_meshes(), "face_colors": colors, "supersampling": 2, "cull_backfaces": False, "near_plane": 0.01}]


def _antialiased() -> list[Arguments]:
    scene = _meshes()
    connectivity = MeshTopology.from_faces(scene.pop("faces"), 12).connectivity
    scene |= {"connectivity": connectivity, "near_plane": 0.01}
    texture = {"texture": torch.rand(8, 6, 3, generator=RNG), "face_uvs": torch.rand(20, 3, 2, generator=RNG)}
    colored = _grown({**scene, "face_colors": torch.rand(20, 3, generator=RNG)})
    return [colored, _grown({**scene, **texture, "max_level": 1})]


def _textures() -> list[Arguments]:
    sampled = {"texture": torch.rand(8, 6, 3, generator=RNG), "uv": torch.rand(5, 4, 2, generator=RNG)}
    return [_grown(sampled), {**sampled, "lod": torch.rand(5, 4, generator=RNG), "max_level": 2}]


def _photos() -> list[Arguments]:
    color, target = torch.rand(2, 1, 14, 13, 3, generator=RNG)
    plain = {"color": color.requires_grad_(), "target": target, "dssim_weight": 0.2}
    rgba = torch.rand(1, 14, 13, 4, generator=RNG).mul(255).byte()
    masked = {"mask": torch.rand(1, 14, 13, generator=RNG), "backgrounds": torch.rand(1, 3, generator=RNG)}
    return [plain, {**plain, "target": rgba, **masked, "pixel": "l2"}]


def _normals() -> list[Arguments]:
    images = {name: torch.rand(1, 8, 9, n, generator=RNG) for name, n in (("normals", 3), ("depth", 1), ("alpha", 1))}
    views = cameras(9, 8, 1)
    return [_grown({**images, "viewmats": views["viewmats"], "Ks": views["Ks"]})]


def _soup_parts() -> dict[str, Tensor]:
    shapes = {"vertices": (9, 3, 3), "sh_dc": (9, 1, 3), "sh_rest": (9, 8, 3)}
    return {name: torch.randn(shape, generator=RNG) for name, shape in shapes.items()}


def _activation(view: bool, **arguments: Any) -> Any:
    camera = Cameras(**cameras(9, 8, 1)) if view else None
    return soup_activation(**arguments, camera=camera)


def _activations() -> list[Arguments]:
    logits, raw = torch.randn(2, 9, generator=RNG)
    corners = torch.randn(9, 3, 3, generator=RNG)
    tensors = {"vertices": corners, "opacity_logits": logits, "sigma_raw": raw}
    return [
        {**tensors, "view": view, "numbers": (0.1, 1.0, 0.2, 3.0), "smallest": 0.5, "largest": 50.0}
        for view in (True, False)
    ]


def _sum(first: Any, second: Any, weight: Any, scale: Any) -> Any:
    return weighted_sum(first, [Term(weight, second), Term(0.5, second, -2)], scale)


def _step(value: Any, gradient: Any, rate: Any, eps: Any) -> None:
    adam = Adam({"value": value}, {"value": rate}, eps=eps)
    try:
        value.grad = gradient
    except RuntimeError as error:  # torch's own check
        raise Refused from error
    adam.step()


def _edit(keep: Any, values: Any) -> Any:
    adam = Adam({"values": values}, {"values": 0.1})
    return etsplat.apply_rows(RowPlan.keeping(keep), adam, {"count": torch.zeros(len(values))})


def _path(kind: Any) -> Callable[..., Any]:
    return lambda viewmats, up, frames: getattr(etsplat, kind)(viewmats, up, frames)


def _plan(vertices: Any, faces: Any, scores: Any, budget_faces: Any) -> Any:
    return etsplat.longest_edge_plan(vertices, MeshTopology.from_faces(faces, len(vertices)), scores, budget_faces)


def _pairs() -> list[Arguments]:
    image, truth = torch.rand(2, 14, 13, 3, generator=RNG)
    return [{"image": image, "truth": truth}]


def _surfaces() -> list[Arguments]:
    vertices, faces = etsplat.icosphere(0)
    both = {"vertices": vertices, "faces": faces, "true_vertices": vertices * 1.1, "true_faces": faces}
    return [{**both, "samples": 50, "seed": 0}]


def _one(**arguments: Any) -> Callable[[], list[Arguments]]:
    return lambda: [_grown(arguments) if "faces" not in arguments else arguments]


_SPHERE = etsplat.icosphere(0)
_VIEWS = etsplat.orbit_cameras(9, 8, azimuths=2)
_EYES = torch.randn(3, 5, 3, generator=RNG)

OPERATIONS = [
    Operation("rasterize", etsplat.rasterize, _splats),
    Operation("rasterize_antialiased", etsplat.rasterize_antialiased, _antialiased),
    Operation("rasterize_opaque", etsplat.rasterize_opaque, lambda: [{**_meshes(), "near_plane": 0.01}]),
    Operation("render_opaque", etsplat.render_opaque, _opaque),
    Operation("sample_texture", etsplat.sample_texture, _textures),
    Operation("photometric_loss", etsplat.photometric_loss, _photos),
    Operation("normal_consistency", etsplat.normal_consistency, _normals),
    Operation(
        "mesh_energies",
        lambda vertices, faces, edge_power: etsplat.mesh_energies(
            vertices, MeshTopology.from_faces(faces, len(vertices)).connectivity, edge_power=edge_power
        ),
        lambda: [{"vertices": _SPHERE[0].clone().requires_grad_(), "faces": _SPHERE[1], "edge_power": 2}],
    ),
    Operation(
        "spherical_harmonics",
        etsplat.spherical_harmonics,
        _one(
            coefficients=torch.randn(9, 9, 3, generator=RNG), directions=torch.randn(2, 9, 3, generator=RNG), degree=2
        ),
    ),
    Operation(
        "soup_colors", soup_colors, lambda: [_grown({**_soup_parts(), "centers": _EYES[0].clone(), "degree": 2})]
    ),
    Operation("soup_activation", _activation, _activations),
    Operation("mean_area", mean_area, _one(vertices=torch.randn(9, 3, 3, generator=RNG))),
    Operation(
        "triangle_channels",
        triangle_channels,
        lambda: [{"corners": _soup_parts()["vertices"], "viewmats": _VIEWS.viewmats, "depth": True, "normals": True}],
    ),
    Operation(
        "pick_values",
        pick_values,
        lambda: [
            {"values": torch.rand(2, 9).requires_grad_(), "chosen": torch.randint(0, 10, (2, 5, 4), dtype=torch.int32)}
        ],
    ),
    Operation("weighted_sum", _sum, _one(first=torch.tensor(0.5), second=torch.tensor(0.3), weight=0.5, scale=1.0)),
    Operation("Adam.step", _step, _one(value=torch.rand(7), gradient=torch.rand(7), rate=0.1, eps=1e-15)),
    Operation(
        "apply_rows", _edit, lambda: [{"keep": torch.arange(7) % 2 == 0, "values": torch.rand(7, 3).requires_grad_()}]
    ),
    Operation(
        "longest_edge_plan", _plan, _one(vertices=_SPHERE[0], faces=_SPHERE[1], scores=torch.rand(20), budget_faces=40)
    ),
    Operation("geometry_metrics", geometry_metrics, _surfaces),
    Operation("psnr", etsplat.psnr, _pairs),
    Operation("flip", etsplat.flip, _pairs),
    Operation("ssim", etsplat.ssim, lambda: [{**_pairs()[0], "interior": True}]),
    Operation(
        "silhouette_iou", etsplat.silhouette_iou, lambda: [{"coverage": torch.rand(5, 6), "truth": torch.rand(5, 6)}]
    ),
    Operation("look_at", etsplat.look_at, _one(eye=_EYES[0].clone(), target=_EYES[1].clone(), up=_EYES[2].clone())),
    Operation("intrinsics", etsplat.intrinsics, lambda: [{"fov_y_degrees": 50.0, "width": 9, "height": 8}]),
    Operation(
        "Cameras",
        lambda viewmats, Ks, width, height, factor: Cameras(viewmats, Ks, width, height).scaled(factor).centers,
        lambda: [{"viewmats": _VIEWS.viewmats, "Ks": _VIEWS.Ks, "width": 9, "height": 8, "factor": 0.5}],
    ),
    *(
        Operation(kind, _path(kind), _one(viewmats=_VIEWS.viewmats.clone(), up=torch.tensor([0.0, 1.0, 0.0]), frames=5))
        for kind in ("ellipse", "interpolated", "orbit", "spiral")
    ),
]
