"""A batch of views of a mesh in one call, with depth and normals.

python examples/02_depth_and_normals.py --out views.png
"""

import argparse

import matplotlib.pyplot as plt
import torch

import etsplat


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--size", type=int, default=256)
    parser.add_argument("--out", default="views.png")
    options = parser.parse_args()

    # An owl that is built in code; etsplat.load_mesh reads files. In the unit sphere, with a colour for each place.
    mesh, _ = etsplat.normalize_mesh(etsplat.demo_object())
    cameras = etsplat.orbit_cameras(options.size, options.size, elevations=(20.0,), azimuths=4)
    seen = etsplat.rasterize(
        mesh.vertices,
        faces=mesh.faces,
        vertex_colors=0.5 + 0.5 * mesh.vertices,
        opacities=torch.ones(len(mesh.faces)),
        sigma=0.05,  # nearly sharp
        cameras=cameras,
        backgrounds=torch.ones(len(cameras), 3),
        outputs=("color", "depth", "normal"),
    )
    assert seen.depth is not None
    assert seen.normal is not None
    depth = seen.depth.where(seen.alpha > 0.5, torch.nan)[..., 0]  # (B, H, W), along the camera's axis
    normal = 0.5 + 0.5 * seen.normal  # (B, H, W, 3), of world space; grey is nothing

    figure, axes = plt.subplots(3, len(cameras), figsize=(2.5 * len(cameras), 7.5), layout="constrained")
    for view in range(len(cameras)):
        axes[0, view].imshow(seen.color[view].clamp(0, 1))
        axes[1, view].imshow(depth[view], cmap="viridis_r")
        axes[2, view].imshow(normal[view].clamp(0, 1))
        axes[0, view].set_title(f"{360 // len(cameras) * view} degrees")
        print(f"view {view}: nearest at {depth[view].nan_to_num(torch.inf).min():.3f}")
    for axis in axes.flat:
        axis.set_axis_off()
    figure.savefig(options.out)


if __name__ == "__main__":
    main()
