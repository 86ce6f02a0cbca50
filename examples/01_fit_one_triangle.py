"""Fit one triangle to a picture of another: the whole of differentiable splatting in a page.

The triangle starts soft, grey and off to the side. Gradients of the mean squared error move its corners, colour and
softness until it covers the target. The picture shows start, result and target. Run it from anywhere:

    python examples/01_fit_one_triangle.py --out triangle.png
"""

import argparse

import torch

import etsplat

SIZE = 96
CAMERA = etsplat.Cameras(torch.eye(4)[None], etsplat.intrinsics(50.0, SIZE, SIZE)[None], SIZE, SIZE)


def render(corners: torch.Tensor, color: torch.Tensor, sigma: torch.Tensor) -> torch.Tensor:
    """One picture (SIZE, SIZE, 3) of one triangle, seen from the origin along +z."""
    return etsplat.rasterize(
        corners[None],  # a soup of one triangle: (1, 3, 3)
        face_colors=color[None],
        opacities=torch.tensor([0.95]),
        sigma=sigma,
        cameras=CAMERA,
    ).color[0]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--steps", type=int, default=300)
    parser.add_argument("--out", default="triangle.png")
    options = parser.parse_args()

    goal = torch.tensor([[-0.5, -0.6, 2.0], [0.7, -0.3, 2.0], [0.1, 0.7, 2.0]])
    target = render(goal, torch.tensor([0.95, 0.55, 0.2]), torch.tensor(0.05))

    corners = torch.tensor([[-0.7, -0.3, 2.0], [0.3, -0.2, 2.0], [-0.3, 0.4, 2.0]], requires_grad=True)
    color = torch.full((3,), 0.5, requires_grad=True)
    log_sigma = torch.zeros((), requires_grad=True)
    optimizer = torch.optim.Adam([{"params": [corners, log_sigma], "lr": 0.02}, {"params": [color], "lr": 0.03}])

    start = render(corners, color, log_sigma.exp()).detach()
    for step in range(1, options.steps + 1):
        loss = (render(corners, color, log_sigma.exp()) - target).square().mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        if step % max(1, options.steps // 6) == 0:
            print(f"step {step:4d}   loss {loss.item():.5f}   sigma {log_sigma.exp().item():.3f}")

    result = render(corners, color, log_sigma.exp()).detach()
    etsplat.save_image(options.out, torch.cat([start, result, target], dim=1))


if __name__ == "__main__":
    main()
