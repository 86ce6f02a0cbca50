"""Train a soup on photos of a scene, and look at it along a path of cameras.

    python examples/06_scene_and_path.py --scene my_scene/ --out runs/scene

The picture, path.png in the folder of the run, shows eight stations of an orbit.
"""

import argparse

import torch

import etsplat


def tell(event: object) -> None:
    """A line now and then. There are other events too, such as checkpoints."""
    if isinstance(event, etsplat.StepEvent):
        print(f"iteration {event.iteration:5d}   loss {event.loss:.4f}   {event.state['triangles']:,.0f} triangles")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--scene", default="demo:scene", help="a folder with posed photos")
    parser.add_argument("--iterations", type=int, default=600)
    parser.add_argument("--width", type=int, default=200)
    parser.add_argument("--out", default="runs/scene")
    options = parser.parse_args()

    config = etsplat.TrainConfig.demo().changed({"iterations": options.iterations, "width": options.width})
    result = etsplat.train(options.scene, options.out, config, callbacks=[tell], overwrite=True)
    print(f"{result.soup.count:,} triangles, PSNR {result.metrics['psnr']:.1f} dB: {result.path}")

    soup = etsplat.TriangleSoup.load(result.path / "soup.safetensors")  # as `result.soup`
    photos = etsplat.demo_scene(options.width, options.width * 3 // 4)
    if options.scene != "demo:scene":
        photos = etsplat.load_dataset(options.scene, width=options.width)
    viewmats = etsplat.orbit(photos.viewmats, up=torch.tensor([0.0, 1.0, 0.0]), frames=8)
    first = photos.cameras[0]
    path = etsplat.Cameras(viewmats.float(), first.Ks.expand(8, 3, 3), first.width, first.height)
    with torch.no_grad():
        frames = [soup.render(path[frame]).color[0] for frame in range(8)]
    rows = [torch.cat(frames[:4], dim=1), torch.cat(frames[4:], dim=1)]
    etsplat.save_image(result.path / "path.png", torch.cat(rows))


if __name__ == "__main__":
    main()
