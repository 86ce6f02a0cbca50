"""What is made of torch's own functions takes and refuses the tensors that native code does: some end the process.

`tests/ops/test_memory.py` has the operations of the engines.
"""

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor
from torch._subclasses.fake_tensor import FakeTensorMode

from etsplat import (
    Adam,
    Cameras,
    RowPlan,
    TriangleMesh,
    TriangleSoup,
    apply_rows,
    flip,
    geometry_metrics,
    icosphere,
    intrinsics,
    look_at,
    normal_consistency,
    psnr,
    save_image,
    save_mesh,
    silhouette_iou,
    spherical_harmonics,
    ssim,
)
from etsplat.data.camera_paths import PATHS
from etsplat.geometry.distance import closest_points
from etsplat.geometry.sampling import sample_surface

Case = tuple[Callable[..., Any], dict[str, Tensor]]


def _cases(folder: Path) -> dict[str, Case]:
    rng = torch.Generator().manual_seed(0)
    points, faces = icosphere(1)
    pair = {"image": torch.rand(20, 24, 3, generator=rng), "truth": torch.rand(20, 24, 3, generator=rng)}
    mesh = {"vertices": points, "faces": faces}
    views = {"viewmats": torch.eye(4).repeat(2, 1, 1), "Ks": intrinsics(50, 24, 20).repeat(2, 1, 1)}
    eye, target, up = torch.randn(3, 5, 3, generator=rng)
    depth, alpha = 1 + torch.rand(2, 2, 20, 24, 1, generator=rng)

    def saved_mesh(**given: Any) -> bytes:
        save_mesh(folder / "mesh.ply", **given)
        return (folder / "mesh.ply").read_bytes()

    def saved_image(image: Tensor) -> bytes:
        save_image(folder / "image.png", image)
        return (folder / "image.png").read_bytes()

    def kept_rows(count: Tensor) -> Tensor:
        return apply_rows(RowPlan.keeping(torch.arange(5) % 2 == 0), Adam({}, {}), {"count": count})[1]["count"]

    return {
        "Cameras": (lambda **given: Cameras(**given, width=24, height=20).centers, views),
        "look_at": (look_at, {"eye": eye, "target": target, "up": up}),
        **{
            name: (partial(path, frames=3), {"viewmats": look_at(eye, torch.zeros(3), up), "up": up[0]})
            for name, path in PATHS.items()
        },
        "apply_rows": (kept_rows, {"count": eye[:, 0]}),
        "psnr": (psnr, pair),
        "ssim": (ssim, pair),
        "flip": (flip, pair),
        "silhouette_iou": (silhouette_iou, {"coverage": pair["image"][..., 0], "truth": pair["truth"][..., 0]}),
        "TriangleSoup": (
            lambda **given: TriangleSoup.from_triangles(**given, opacity=0.8, sigma=0.5, sh_degree=1).sh_dc,
            {"vertices": points[faces], "colors": torch.rand(len(faces), 3, generator=rng)},
        ),
        "TriangleMesh": (
            lambda **given: TriangleMesh.from_mesh(**given, opacity=0.8, sigma=0.5).colors,
            {**mesh, "colors": torch.rand(len(faces), 3, generator=rng)},
        ),
        "save_mesh": (saved_mesh, {**mesh, "face_colors": torch.rand(len(faces), 3, generator=rng)}),
        "save_image": (saved_image, {"image": pair["image"]}),
        "geometry_metrics": (
            lambda **given: geometry_metrics(**given, true_vertices=points, true_faces=faces, samples=100),
            mesh,
        ),
        "sample_surface": (lambda **given: sample_surface(**given, count=9, seed=0)[0], mesh),
        "closest_points": (lambda **given: closest_points(**given)[0], {"points": eye, **mesh}),
        "spherical_harmonics": (
            lambda **given: spherical_harmonics(**given, degree=1),
            {"coefficients": torch.randn(5, 4, 3, generator=rng), "directions": eye},
        ),
        "normal_consistency": (
            normal_consistency,
            {"normals": torch.randn(2, 20, 24, 3, generator=rng), "depth": depth, "alpha": alpha, **views},
        ),
    }


NAMES = list(_cases(Path()))


def _odd(value: Tensor) -> dict[str, Any]:
    freed, short = value.clone(), value.clone()
    freed.untyped_storage().resize_(0)
    short.untyped_storage().resize_(short.untyped_storage().nbytes() - 1)
    return {
        "freed": freed,
        "short": short,
        "zero": torch._efficientzerotensor(value.shape, dtype=value.dtype),  # pyright: ignore[reportPrivateImportUsage]
        "meta": value.to("meta"),
        "fake": FakeTensorMode().from_tensor(value),  # what torch.export hands in; its address was read
        "sparse": value.to_sparse(),
        "nested": torch.nested.nested_tensor([torch.rand(2, 3)]),
        "quantized": torch.quantize_per_tensor(value.float(), 0.1, 0, torch.quint8),
        "complex": value.to(torch.complex64),
        "list": value.tolist(),
    }


def _message(run: Callable[..., Any], arguments: dict[str, Any]) -> str:
    """Of the ValueError; whatever else is raised, in words: pytest cannot show a freed tensor."""
    try:
        run(**arguments)
    except ValueError as error:
        return str(error)
    except Exception as error:
        return f"({type(error).__name__}) {error}"
    return "(taken)"


@pytest.mark.filterwarnings(
    "ignore:The PyTorch API of nested tensors", "ignore:Sparse", "ignore:Accessing the data pointer of FakeTensor"
)
@pytest.mark.parametrize("name", NAMES)
def test_tensors_without_numbers_in_memory_are_refused_by_name(name: str, tmp_path: Path) -> None:
    run, arguments = _cases(tmp_path)[name]
    told = {
        (key, kind): _message(run, {**arguments, key: odd})
        for key, value in arguments.items()
        for kind, odd in _odd(value).items()
        if (name, kind) not in {("look_at", "list"), ("TriangleMesh", "list")}  # tuples and a number will do there
    }
    assert {place: text for place, text in told.items() if not text.startswith(f"{place[0]} must ")} == {}


@pytest.mark.parametrize("name", NAMES)
def test_a_sign_that_is_not_in_memory_counts(name: str, tmp_path: Path) -> None:
    run, arguments = _cases(tmp_path)[name]
    expected = run(**arguments)
    for key, value in arguments.items():
        odd = torch._neg_view(-value)  # pyright: ignore[reportPrivateImportUsage]
        assert odd.is_neg()
        found = run(**{**arguments, key: odd})
        assert torch.equal(found, expected) if isinstance(expected, Tensor) else found == expected, key
