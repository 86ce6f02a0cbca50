"""What a normal map is worth where a mesh is lit: a light mesh with the full one's relief, without, and upside down.

    python -m benchmarks.relief RUN --npm FOLDER [--blender PYTHON] [--file textured_lod1.glb] [--keep PICTURE.png]

In grey, lit from above the camera, PSNR of pictures of the light mesh against those of the full one at some test views,
as three.js and Blender draw them (`benchmarks.elsewhere` says what these need). Upside down, with the axis turned that
programs disagree about, is what a wrong convention would look like.
"""

import argparse
from dataclasses import replace
from pathlib import Path
from statistics import fmean
from tempfile import TemporaryDirectory

import torch
from torch import Tensor

from benchmarks.elsewhere.__main__ import blender_pictures, three_pictures
from benchmarks.elsewhere.server import serving
from benchmarks.elsewhere.subject import Subject
from etsplat.io.images import save_image
from etsplat.metrics.image import psnr
from etsplat.model.textured_mesh import TexturedMesh
from etsplat.tasks.export_mesh import open_reconstruction
from etsplat.tasks.normal_map import normal_map_of
from tests.helpers.browser import browser_page

VIEWS, GREY = 4, 0.8
FLAT = torch.tensor([128, 128, 255], dtype=torch.uint8)


def write_meshes(folder: Path, run: Path, name: str) -> dict[str, Subject]:
    """Files of the four meshes, the full one first."""
    opened = open_reconstruction(run)
    frame, full = opened.views.normalization, opened.mesh
    light = TexturedMesh.load(run / name)
    grey = torch.full_like(light.texture.detach(), GREY)
    light = replace(light, vertices=frame.apply(light.vertices.detach()), texture=grey).learnable()
    relief = normal_map_of(light, full)
    turned = torch.stack([relief.pixels[..., 0], 255 - relief.pixels[..., 1], relief.pixels[..., 2]], dim=-1)
    whole = TexturedMesh.from_mesh(full.vertices, full.faces, grey[:8, :8], torch.zeros(len(full.faces), 3, 2))
    flat = replace(relief, pixels=FLAT.expand_as(relief.pixels).contiguous())
    own = replace(
        normal_map_of(whole, full), pixels=FLAT.expand(8, 8, 3).contiguous()
    )  # it has its normals at its corners
    written = {"full": (whole, own), "relief": (light, relief), "without": (light, flat)}
    written["upside down"] = light, replace(relief, pixels=turned)
    found = {}
    for kind, (mesh, normals) in written.items():
        file = folder / f"{kind}.glb"
        opened.in_own_units(mesh).save(file, normals)
        found[kind] = Subject(
            file, opened.in_own_units(light), opened.views, (0.0, 0.0, 0.0), frame.invert, frame.apply
        )
    return found


def report(program: str, pictures: dict[str, list[Tensor]]) -> None:
    full = pictures["full"]
    numbers = {kind: fmean(map(psnr, found, full)) for kind, found in pictures.items() if kind != "full"}
    print(f"{program}: " + ", ".join(f"{kind} {number:.2f}" for kind, number in numbers.items()), flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path)
    parser.add_argument("--npm", type=Path, required=True)
    parser.add_argument("--blender", type=Path)
    parser.add_argument("--file", default="textured_lod1.glb")
    parser.add_argument("--keep", type=Path)
    options = parser.parse_args()
    with TemporaryDirectory() as folder:
        subjects = write_meshes(Path(folder), options.run, options.file)
        shots, pictures = subjects["full"].shots()[:VIEWS], {}
        for kind, subject in subjects.items():
            with serving(options.npm, subject.file) as server, browser_page() as page:
                pictures[kind] = three_pictures(page, server, subject, shots, 2)
        report("three.js", pictures)
        if options.keep:
            save_image(options.keep, torch.cat([torch.cat(row, dim=1) for row in zip(*pictures.values(), strict=True)]))
        if options.blender:
            report("Blender", {kind: blender_pictures(options.blender, each, shots) for kind, each in subjects.items()})


if __name__ == "__main__":
    main()
