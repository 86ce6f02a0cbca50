"""What is photographed: an exported file, the views of its run in the file's own frame, and our pictures of it."""

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from etsplat.core.cameras import Cameras, look_at
from etsplat.data.dataset import Dataset
from etsplat.geometry.similarity import Similarity
from etsplat.io.mesh_files import load_mesh
from etsplat.model.model import Model
from etsplat.model.textured_mesh import TexturedMesh
from etsplat.model.triangle_mesh import TriangleMesh
from etsplat.tasks.export_mesh import is_reconstruction, open_reconstruction
from etsplat.tasks.opened_runs import open_run
from etsplat.tasks.scoring import Scorer
from tests.helpers.gltf import read_glb

AROUND, SIDE, ANGLE = 6, 400, 40.0
"""Pictures from around an object: how many, pixels along each side, degrees that they span."""

OPENGL = torch.diag(torch.tensor([1.0, -1, -1], dtype=torch.float64))
"""From axes x right, y up, z backward to those of `Cameras`."""


@dataclass(frozen=True)
class Shot:
    """A view of a file.

    Attributes:
        name: of the view.
        camera: one, in the frame of the file.
        photo: (H, W, 3) over the background; our own picture where there is no photo.
        ours: (H, W, 3) our picture.
        counting: puts the photo's pixels into a picture where the view's mask leaves them out.
        near, far: distances between which everything in the file lies.
        orbit: the camera as <model-viewer> is told.
    """

    name: str
    camera: Cameras
    photo: Tensor
    ours: Tensor
    counting: Callable[[Tensor], Tensor]
    near: float
    far: float
    orbit: dict[str, Any] = field(default_factory=dict)

    def view(self, scale: int) -> dict[str, Any]:
        """For other programs: pose and projection as OpenGL has them, row by row, of a picture so many times larger."""
        pose = torch.linalg.inv(self.camera.viewmats[0].double())
        pose[:3, :3] @= OPENGL
        (fx, _, cx), (_, fy, cy), _ = self.camera.Ks[0].tolist()
        width, height, near, far = self.camera.width, self.camera.height, self.near, self.far
        projection = [
            *(2 * fx / width, 0, 1 - 2 * cx / width, 0),
            *(0, 2 * fy / height, 2 * cy / height - 1, 0),
            *(0, 0, (near + far) / (near - far), 2 * near * far / (near - far)),
            *(0, 0, -1, 0),
        ]
        return {
            "width": scale * width,
            "height": scale * height,
            "near": near,
            "far": far,
            "pose": pose.flatten().tolist(),
            "projection": projection,
            "intrinsics": [fx, fy, cx, cy],
        }


@dataclass(frozen=True)
class Subject:
    """A file with the views of its run.

    Attributes:
        file: the GLB.
        model: what is in it, in its own frame.
        views: of the run, in their frame.
        background: behind pictures.
        to_file: points from the frame of the views to that of the file.
        to_views: and back.
    """

    file: Path
    model: TexturedMesh | TriangleMesh
    views: Dataset
    background: tuple[float, float, float]
    to_file: Callable[[Tensor], Tensor]
    to_views: Callable[[Tensor], Tensor]

    @property
    def is_object(self) -> bool:
        """Whether one looks at it from around; a scene is around who looks."""
        return isinstance(self.model, TexturedMesh)

    def shots(self) -> list[Shot]:
        """The test views."""
        scorer = Scorer(self.views, torch.device("cpu"), background=self.background)
        model: Model = replace(self.model, vertices=self.to_views(self.model.vertices.detach()).float())
        found = []
        for index in self.views.test:
            seen, camera = scorer.see(model, index), moved(self.views.cameras[index], self.to_file)
            ours = seen.counting(seen.opaque)
            found.append(Shot(f"{index:03d}", camera, seen.photo, ours, seen.counting, *self.depths(camera)))
        return found

    def depths(self, camera: Cameras) -> tuple[float, float]:
        """Between which everything is that can be seen."""
        far = float((self.model.vertices.detach().double() - camera.centers[0]).norm(dim=1).max())
        return 2e-4 * far, 1.1 * far


def moved(camera: Cameras, to_frame: Callable[[Tensor], Tensor]) -> Cameras:
    """One camera, in float64, in the frame that points are taken to: turned, scaled, moved."""
    pose = torch.linalg.inv(camera.viewmats[0].double())
    center, placed = pose[:3, 3], torch.eye(4, dtype=torch.float64)
    axes = to_frame(center + pose[:3, :3].T) - to_frame(center)
    placed[:3, :3], placed[:3, 3] = torch.nn.functional.normalize(axes, dim=1).T, to_frame(center)
    return replace(camera, viewmats=torch.linalg.inv(placed)[None], Ks=camera.Ks.double())


def subject_of(run: Path, name: str | None) -> Subject:
    """A run's textured.glb or opaque.glb, or another file in its folder."""
    if is_reconstruction(run):
        opened, file = open_reconstruction(run), run / (name or "textured.glb")
        frame = opened.views.normalization
        return Subject(
            file,
            TexturedMesh.load(file),
            opened.views,
            (0.0, 0.0, 0.0),
            frame.invert,
            frame.apply,
        )
    opened, file = open_run(run, device="cpu"), run / (name or "opaque.glb")
    record = read_glb(file)[0]["asset"]["extras"]["etsplat"]
    frame = Similarity.of_matrix(torch.tensor(record["transform"], dtype=torch.float64))
    mesh = load_mesh(file)
    assert mesh.vertex_colors is not None
    model = TriangleMesh.from_mesh(
        mesh.vertices, mesh.faces, colors=mesh.vertex_colors, opacity=None, sigma=None, vertex_colored=True
    )
    behind = opened.soup.appearance.background
    return Subject(file, model, opened.needed_capture(), behind, frame.apply, frame.invert)


def around(subject: Subject) -> list[Shot]:
    """Pictures of ours from around the file, upright: photos are wherever they are."""
    vertices = subject.model.vertices.detach().double()
    middle = (vertices.amin(dim=0) + vertices.amax(dim=0)) / 2
    radius = float((vertices - middle).norm(dim=1).max())
    distance, focal = 1.1 * radius / math.sin(math.radians(ANGLE / 2)), SIDE / 2 / math.tan(math.radians(ANGLE / 2))
    K = torch.tensor([[focal, 0, SIDE / 2], [0, focal, SIDE / 2], [0, 0, 1]], dtype=torch.float64)
    shots = []
    for number in range(AROUND):
        angle, down = 360 * number / AROUND, 60 + 10 * (number % 3)
        a, d = math.radians(angle), math.radians(down)
        back = torch.tensor([math.sin(d) * math.sin(a), math.cos(d), math.sin(d) * math.cos(a)], dtype=torch.float64)
        viewmat = look_at(middle + distance * back, middle, torch.tensor([0.0, 1, 0], dtype=torch.float64))
        camera = Cameras(viewmat[None], K[None], SIDE, SIDE)
        picture = subject.model.render_opaque(replace(camera, viewmats=camera.viewmats.float(), Ks=camera.Ks.float()))
        ours = picture[0, ..., :3].clamp(0, 1)
        orbit = {"around": angle, "down": down, "distance": distance, "angle": ANGLE, "target": middle.tolist()}
        shots.append(Shot(f"{number:03d}", camera, ours, ours, lambda picture: picture, *subject.depths(camera), orbit))
    return shots
