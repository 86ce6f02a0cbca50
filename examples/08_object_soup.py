"""A soup of an object: any model goes with any photos.

Triangles start at random places, multiply and die. The picture shows test views: the soup, the photos.

    python examples/08_object_soup.py --out soup.png
"""

import argparse

import torch

import etsplat


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--iterations", type=int, default=1000)
    parser.add_argument("--out", default="soup.png")
    options = parser.parse_args()

    photos = etsplat.photograph(etsplat.demo_object(), 128, 128)
    generator = torch.Generator().manual_seed(0)
    places = etsplat.StartPoints(2 * torch.rand((2000, 3), generator=generator) - 1, torch.full((2000, 3), 0.5))
    soup = etsplat.start_soup(places, generator, scale=1.0, opacity=0.3, sigma=1.0, sh_degree=1)
    trainer = etsplat.Trainer(
        soup,
        photos,
        etsplat.Objective(etsplat.Photometric(dssim=0.2), [etsplat.Opacity(0.005)]),
        etsplat.DensifyAndPrune(every=50, last=options.iterations * 3 // 4, max_triangles=10_000),
        seed=generator,
    )
    trainer.fit(options.iterations, callbacks=[print], log_every=100)

    pictures = []
    for view in photos.test[2:6]:
        photo = photos.images[view][..., :3]
        with torch.no_grad():
            picture = soup.render(photos.cameras[view]).color[0]
        print(f"test view {photos.names[view]}: PSNR {etsplat.psnr(picture.clamp(0, 1), photo):.1f} dB")
        pictures.append(torch.cat([picture, photo]))
    etsplat.save_image(options.out, torch.cat(pictures, dim=1))


if __name__ == "__main__":
    main()
