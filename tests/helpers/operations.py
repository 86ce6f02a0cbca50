"""Every differentiable operation on small input, for tests that hold for all of them."""

from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from typing import Any

import torch
from torch import Tensor

from etsplat import Cameras, TriangleMesh, TriangleSoup, intrinsics, look_at, rasterize, rasterize_antialiased
from etsplat.core.soup_numbers import SoupNumbers
from etsplat.geometry.icosphere import icosphere
from etsplat.geometry.topology import MeshTopology
from etsplat.ops.mesh_energies import mesh_energies
from etsplat.ops.normal_consistency import normal_consistency
from etsplat.ops.photometric import photometric_loss
from etsplat.ops.pick_values import pick_values
from etsplat.ops.soup_activation import soup_activation
from etsplat.ops.soup_colors import soup_colors
from etsplat.ops.spherical_harmonics import spherical_harmonics
from etsplat.ops.texture import sample_texture
from etsplat.ops.triangle_area import mean_area
from etsplat.ops.triangle_channels import triangle_channels
from etsplat.ops.weighted_sum import Term, weighted_sum
from helpers.engines import device_of, dtype_of, on
from helpers.scenes import DIFFERENTIABLE, EVERYTHING, NO_CUTOFFS, Scene, cameras, mesh, soup

Run = Callable[..., list[Tensor]]
Case = tuple[dict[str, Tensor], Run]
"""What gradients reach, by name, and the function from it to the differentiable outputs."""

Factory = Callable[[torch.Generator, str], Case]
"""Makes the case of a generator and the name of an engine, in that engine's precision."""


def case(engine: str, leaves: Mapping[str, Tensor], function: Callable[..., Any], /, **constants: Any) -> Case:
    """A function of leaves and constants, on an engine; it returns a tensor, or several."""
    dtype = dtype_of(engine)
    fixed = {name: _precise(value, dtype) for name, value in constants.items()}

    def run(**given: Tensor) -> list[Tensor]:
        found = on(engine, function, **given, **fixed)
        return [found] if isinstance(found, Tensor) else list(found)

    return {name: leaf.to(dtype) for name, leaf in leaves.items()}, run


def _precise(value: Any, dtype: torch.dtype) -> Any:
    floating = isinstance(value, Tensor) and value.is_floating_point()
    return value.to(dtype=dtype) if floating or isinstance(value, Cameras) else value


def _splat(scene: Scene, engine: str, **options: Any) -> Case:
    leaves = {name: scene[name] for name in DIFFERENTIABLE if name in scene}

    def draw(**arguments: Any) -> list[Tensor]:
        result = rasterize(**arguments)
        images = result.color, result.alpha, result.depth, result.median_depth, result.normal, result.distortion
        return [image for image in images if image is not None]

    return case(engine, leaves, draw, **{k: v for k, v in scene.items() if k not in leaves}, **options)


def _rasterize(rng: torch.Generator, engine: str, **options: Any) -> Case:
    return _splat(soup(rng, 40, **options), engine)


def _rasterize_everything(rng: torch.Generator, engine: str) -> Case:
    scene = mesh(rng)
    scene["vertex_colors"] = torch.rand(len(scene["vertices"]), 3, generator=rng)
    del scene["face_colors"]
    return _splat(scene, engine, **EVERYTHING)


def _rasterize_smoothly(rng: torch.Generator, engine: str) -> Case:
    """Everything of a few pixels without cut-offs, whose steps finite differences would see."""
    scene = soup(rng, 4, width=6, height=5, channels=2, size=0.7)
    free = torch.tensor([[1.0, 0.0, 1.0], [0.0, 1.0, 1.0], [0.0, 0.0, 0.0]])  # other entries of Ks are no parameters
    leaves = {name: scene[name] for name in DIFFERENTIABLE if name in scene}

    def draw(Ks: Tensor, fixed: Tensor, **arguments: Any) -> list[Tensor]:
        out = rasterize(Ks=fixed + free.to(Ks) * (Ks - fixed), **arguments, cutoffs=NO_CUTOFFS, **EVERYTHING)
        assert out.depth is not None
        # The quotient of two tiny sums far from all triangles is too badly conditioned.
        images = out.color, out.alpha, out.depth * out.alpha, out.median_depth, out.normal, out.distortion
        return [image for image in images if image is not None]

    size = {"width": scene["width"], "height": scene["height"]}
    return case(engine, leaves, draw, fixed=scene["Ks"].clone(), **size)


def _antialiased(rng: torch.Generator, engine: str, kind: str) -> Case:
    scene = mesh(rng)
    faces, points = scene["faces"], scene["vertices"]
    shapes = {"face_colors": (len(faces), 3), "vertex_colors": (len(points), 3)}
    shapes["texture"] = (15, 24, 3)  # of one level: which one is shown has no gradient
    leaves = {"vertices": points, kind: torch.rand(shapes[kind], generator=rng), "backgrounds": scene["backgrounds"]}
    if kind == "texture":
        leaves["face_uvs"] = torch.rand(len(faces), 3, 2, generator=rng)

    def draw(**arguments: Any) -> Tensor:
        return rasterize_antialiased(**arguments).color

    view = Cameras(scene["viewmats"], scene["Ks"], scene["width"], scene["height"])
    connectivity = MeshTopology.from_faces(faces, len(points)).connectivity
    return case(engine, leaves, draw, cameras=view, connectivity=connectivity)


def _texture(rng: torch.Generator, engine: str) -> Case:
    leaves = {"texture": torch.rand(8, 12, 3, generator=rng), "uv": 1.2 * torch.rand(20, 2, generator=rng) - 0.1}
    return case(engine, leaves, sample_texture, lod=3 * torch.rand(20, generator=rng) - 0.5)


def _soup_activation(rng: torch.Generator, engine: str) -> Case:
    logits, raw = torch.randn(2, 30, generator=rng)
    camera = Cameras(torch.eye(4)[None], intrinsics(50, 32, 32)[None], 32, 32)
    leaves = {"opacity_logits": logits, "sigma_raw": raw}
    corners = torch.randn(30, 3, 3, generator=rng)
    return case(
        engine, leaves, soup_activation, vertices=corners, numbers=SoupNumbers(0.1, 1.0, 0.2, 3.0), camera=camera
    )


def _soup_colors(rng: torch.Generator, engine: str) -> Case:
    leaves = {
        "vertices": torch.randn(30, 3, 3, generator=rng),
        "sh_dc": torch.randn(30, 1, 3, generator=rng),
        "sh_rest": torch.randn(30, 8, 3, generator=rng),
    }
    return case(engine, leaves, soup_colors, centers=torch.randn(2, 3, generator=rng), degree=2)


def _harmonics(rng: torch.Generator, engine: str) -> Case:
    leaves = {"coefficients": torch.randn(30, 9, 3, generator=rng), "directions": torch.randn(30, 3, generator=rng)}
    return case(engine, leaves, spherical_harmonics, degree=2)


def _mean_area(rng: torch.Generator, engine: str) -> Case:
    return case(engine, {"vertices": torch.randn(30, 3, 3, generator=rng)}, mean_area)


def _photometric(rng: torch.Generator, engine: str) -> Case:
    color, target = torch.rand(2, 2, 20, 24, 3, generator=rng)
    return case(engine, {"color": color}, photometric_loss, target=target, dssim_weight=0.2)


def _normal_consistency(rng: torch.Generator, engine: str) -> Case:
    leaves = {
        "normals": torch.nn.functional.normalize(torch.randn(2, 20, 24, 3, generator=rng), dim=-1),
        "depth": 2 + torch.rand(2, 20, 24, 1, generator=rng),
    }
    view = {"viewmats": torch.eye(4).expand(2, 4, 4), "Ks": intrinsics(50, 24, 20).expand(2, 3, 3)}
    return case(engine, leaves, normal_consistency, alpha=torch.rand(2, 20, 24, 1, generator=rng), **view)


def _mesh_energies(rng: torch.Generator, engine: str) -> Case:
    vertices, faces = icosphere(1)
    points = vertices.float() + 0.1 * torch.randn(vertices.shape, generator=rng)
    connectivity = MeshTopology.from_faces(faces, len(vertices)).connectivity
    return case(engine, {"vertices": points}, mesh_energies, connectivity=connectivity)


def _channels(rng: torch.Generator, engine: str) -> Case:
    scene = soup(rng, 30)
    leaves = {"corners": scene["vertices"], "viewmats": scene["viewmats"]}
    return case(engine, leaves, triangle_channels, depth=True, normals=True)


def _pick_values(rng: torch.Generator, engine: str) -> Case:
    chosen = torch.randint(0, 31, (2, 20, 24), generator=rng, dtype=torch.int32)
    return case(engine, {"values": torch.rand(2, 30, generator=rng)}, pick_values, chosen=chosen)


def _weighted_sum(rng: torch.Generator, engine: str) -> Case:
    first, second = torch.rand(2, generator=rng)

    def total(first: Tensor, second: Tensor) -> Tensor:
        return weighted_sum(first, [Term(0.5, second, -2)])

    return case(engine, {"first": first, "second": second}, total)


def _look_at(rng: torch.Generator, engine: str) -> Case:
    names = ("eye", "target", "up")
    return case(engine, dict(zip(names, torch.randn(3, 5, 3, generator=rng), strict=True)), look_at)


def _soup_render(rng: torch.Generator, engine: str) -> Case:
    corners, colors = soup(rng, 40)["vertices"], torch.rand(40, 3, generator=rng)
    drawn = TriangleSoup.from_triangles(corners, colors, opacity=0.8, sigma=0.5, sh_degree=1)

    def draw(cameras: Cameras, **parameters: Tensor) -> Tensor:
        return replace(drawn, **parameters).render(cameras).color

    return case(engine, drawn.state(), draw, cameras=Cameras(**cameras(48, 40)))


def _mesh_render(rng: torch.Generator, engine: str) -> Case:
    scene = mesh(rng)
    drawn = TriangleMesh.from_mesh(
        scene["vertices"], scene["faces"], colors=scene["face_colors"], opacity=0.8, sigma=0.5
    ).to(torch.device(device_of(engine)))

    def draw(cameras: Cameras, **parameters: Tensor) -> Tensor:
        return replace(drawn, **parameters).render(cameras).color

    leaves = {name: parameter.detach().cpu() for name, parameter in drawn.parameters().items()}
    return case(engine, leaves, draw, cameras=Cameras(**cameras(48, 40)))


CASES: dict[str, Factory] = {
    "rasterize": _rasterize,
    "rasterize/many channels": partial(_rasterize, channels=20),
    "rasterize/everything": _rasterize_everything,
    "rasterize_antialiased/face_colors": partial(_antialiased, kind="face_colors"),
    "rasterize_antialiased/vertex_colors": partial(_antialiased, kind="vertex_colors"),
    "rasterize_antialiased/texture": partial(_antialiased, kind="texture"),
    "sample_texture": _texture,
    "soup_activation": _soup_activation,
    "soup_colors": _soup_colors,
    "spherical_harmonics": _harmonics,
    "mean_area": _mean_area,
    "photometric_loss": _photometric,
    "normal_consistency": _normal_consistency,
    "mesh_energies": _mesh_energies,
    "triangle_channels": _channels,
    "pick_values": _pick_values,
    "weighted_sum": _weighted_sum,
}
"""By the operation's name, and what is special about the case."""

COMPOSED: dict[str, Factory] = {
    "look_at": _look_at,
    "TriangleSoup.render": _soup_render,
    "TriangleMesh.render": _mesh_render,
}
"""What is made of these and of torch."""

SMOOTH = {**CASES, **dict.fromkeys((name for name in CASES if name.split("/")[0] == "rasterize"), _rasterize_smoothly)}
"""For finite differences."""


def loss(outputs: list[Tensor]) -> Tensor:
    """A number that depends on every element of every output."""
    return torch.stack([(output * output).sum() for output in outputs]).sum()
