"""A kernel of one's own: G(x) in torch, drawn by every engine at full speed, fitted to the owl of `etsplat demo`.

python examples/03_own_kernel.py --out runs/plateau
"""

import argparse

import matplotlib.pyplot as plt
import torch

import etsplat


def plateau(x: torch.Tensor, sigma: torch.Tensor) -> torch.Tensor:
    """1 inside of the triangle, 1/2 on its edge (x = 1), 0 outside; sigma says how gradually."""
    return torch.sigmoid((1.0 - x) / (0.25 * sigma))


def plot(path: str) -> None:
    """G(x) for some sigma beside the paper's elastic kernel."""
    x = torch.linspace(0.0, 2.0, 200)
    for sigma, color in ((0.1, "tab:blue"), (0.3, "tab:orange"), (1.0, "tab:green")):
        plt.plot(x, plateau(x, torch.tensor(sigma)), color=color, label=f"sigma = {sigma}")
        plt.plot(x, torch.exp(-sigma * x ** (2.0 / sigma)), color=color, linestyle=":")
    plt.xlabel("x (dotted: elastic)")
    plt.legend()
    plt.savefig(path)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--out", default="runs/plateau")
    parser.add_argument("--preset", choices=["demo", "tiny"], default="demo")
    options = parser.parse_args()

    error = etsplat.register_kernel("plateau", plateau)
    print(f"what the native engines draw is within {error.elsewhere:.0e} of the function")
    config = etsplat.ReconstructConfig.of(options.preset).changed({"method": "plateau"})
    result = etsplat.reconstruct(etsplat.demo_object(), options.out, config, overwrite=True)
    plot(f"{options.out}/kernel.png")
    print(f"{len(result.mesh.faces):,} faces, PSNR {result.metrics['psnr']:.1f} dB; {options.out}")


if __name__ == "__main__":
    main()
