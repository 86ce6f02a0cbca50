"""A loss term of one's own: all photos show one side of the owl, and the term says that it is symmetric.

The picture shows a view from the side without photos: without the term, with it, and what is there.

    python examples/04_own_loss.py --out symmetry.png
"""

import argparse
from dataclasses import replace

import torch

import etsplat

MIRROR = torch.diag(torch.tensor([-1.0, 1.0, 1.0, 1.0]))


def asymmetry(drawing: etsplat.Drawing) -> torch.Tensor:
    """How far the picture is from what a camera beyond the plane x = 0 sees in a mirror."""
    camera = drawing.camera
    beyond = etsplat.Cameras(MIRROR @ camera.viewmats @ MIRROR, camera.Ks, camera.width, camera.height)
    seen = drawing.model.render(beyond, backgrounds=drawing.background)
    return (seen.color.flip(2) - drawing.rendering.color).abs().mean()


def fit(photos: etsplat.Dataset, weight: float, iterations: int) -> etsplat.TriangleMesh:
    """A ball that becomes the owl: paper section 3.3 in small, with the term."""
    vertices, faces = etsplat.icosphere(3)
    mesh = etsplat.TriangleMesh.from_mesh(vertices, faces, colors=0.7, opacity=0.98, sigma=0.25)
    own = etsplat.Custom(asymmetry, weight, outputs=("color",))
    terms = [etsplat.EdgeLength(0.5), etsplat.SmoothNormals(0.02), etsplat.Laplacian(0.2), own]
    faster = etsplat.Schedule({**mesh.rates, "vertices": 1e-2})
    trainer = etsplat.Trainer(mesh, photos, etsplat.Objective(etsplat.Photometric(), terms), schedule=faster)
    trainer.fit(iterations, callbacks=[print], log_every=100)
    return trainer.model


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--iterations", type=int, default=500)
    parser.add_argument("--out", default="symmetry.png")
    options = parser.parse_args()

    photos = etsplat.photograph(etsplat.demo_object(), 128, 128)
    right = [view for view in range(len(photos)) if photos.centers[view, 0] > 0.1]
    test = int(photos.centers[:, 0].argmin())
    photos = replace(photos, train=right, test=[test])
    pictures = []
    for weight in (0.0, 1.0):
        mesh = fit(photos, weight, options.iterations)
        pictures.append(mesh.render(photos.cameras[test]).color[0].detach())
        print(f"weight {weight:g}: PSNR {etsplat.psnr(pictures[-1], photos.images[test][..., :3]):.1f} dB")
    etsplat.save_image(options.out, torch.cat([*pictures, photos.images[test][..., :3]], dim=1))


if __name__ == "__main__":
    main()
