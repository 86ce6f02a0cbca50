"""Find out where photos were taken from: gradients reach poses and intrinsics.

The cameras start turned, shifted and with a wrong focal length. The picture shows, for each of them, the photo and
how far the model is from it at the start and at the end.

    python examples/07_camera_refinement.py --out cameras.png
"""

import argparse

import torch

import etsplat

SIZE = 128


def moved(cameras: etsplat.Cameras, motions: torch.Tensor, zoom: torch.Tensor) -> etsplat.Cameras:
    """Cameras shifted and turned by (B, 6), and with another focal length; differentiable by both."""
    motion = torch.zeros(len(motions), 4, 4)
    motion[:, :3, 3] = motions[:, :3]
    motion[:, :3, :3] = torch.linalg.cross(torch.eye(3)[None], motions[:, None, 3:])  # about the three axes
    viewmats = torch.linalg.matrix_exp(motion) @ cameras.viewmats
    columns = torch.cat([zoom.exp().expand(2), torch.ones(1)])
    return etsplat.Cameras(viewmats, cameras.Ks * columns, cameras.width, cameras.height)


def projected(cameras: etsplat.Cameras, points: torch.Tensor) -> torch.Tensor:
    """Where points (P, 3) are on the images of B cameras, (B, P, 2) in pixels."""
    seen = points @ cameras.viewmats[:, :3, :3].mT + cameras.viewmats[:, None, :3, 3]
    pixels = seen @ cameras.Ks.mT
    return pixels[..., :2] / pixels[..., 2:]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--steps", type=int, default=120)
    parser.add_argument("--out", default="cameras.png")
    options = parser.parse_args()

    # A model that is known; where it is not, its parameters go into the optimizer too.
    owl, _ = etsplat.normalize_mesh(etsplat.demo_object())
    colors = 0.5 + 0.5 * torch.sin(5.0 * owl.vertices)
    model = etsplat.TriangleMesh.from_mesh(
        owl.vertices, owl.faces, colors=colors, opacity=0.98, sigma=0.25, vertex_colored=True
    )
    truth = etsplat.orbit_cameras(SIZE, SIZE, elevations=(20.0,), azimuths=4)
    photos = model.render_opaque(truth)[..., :3]

    noise = torch.randn((len(truth), 6), generator=torch.Generator().manual_seed(0))
    start = moved(truth, 0.04 * noise, torch.tensor(0.05))
    motions, zoom = torch.zeros(len(truth), 6, requires_grad=True), torch.zeros((), requires_grad=True)
    optimizer = torch.optim.Adam([motions, zoom], lr=2e-3)
    for step in range(options.steps + 1):
        cameras = moved(start, motions, zoom)
        loss = (model.render(cameras).color - photos).abs().mean()
        if step % max(1, options.steps // 6) == 0:
            error = (projected(cameras, owl.vertices) - projected(truth, owl.vertices)).norm(dim=-1).mean()
            focal = cameras.Ks[0, 0, 0] / truth.Ks[0, 0, 0] - 1
            print(f"step {step:4d}   loss {loss:.4f}   off by {error:.2f} pixels, the focal length by {focal:+.1%}")
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()

    before, after = ((model.render(c).color.detach() - photos).abs() for c in (start, moved(start, motions, zoom)))
    rows = [torch.cat([*kind], dim=1) for kind in (photos, before, after)]
    etsplat.save_image(options.out, torch.cat(rows))


if __name__ == "__main__":
    main()
