"""Reconstruct a mesh from Python: settings, a callback, and what comes out.

python examples/02_reconstruct_demo.py --out runs/example
"""

import argparse
from dataclasses import replace

import etsplat
from etsplat.optim.loop import RefineEvent, StepEvent


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--out", default="runs/example")
    parser.add_argument("--preset", default="demo")
    options = parser.parse_args()

    def tell(event: object) -> None:
        if isinstance(event, StepEvent):
            print(f"iteration {event.iteration:5d}   loss {event.loss:.4f}   sigma {event.state['sigma']:.3f}")
        elif isinstance(event, RefineEvent):
            print(f"iteration {event.iteration:5d}   now {event.count:,} faces")

    result = etsplat.reconstruct(
        etsplat.demo_object(),  # or a path: a mesh file, or a folder with posed images
        options.out,
        replace(etsplat.ReconstructConfig.of(options.preset), seed=1),
        callbacks=[tell],
        overwrite=True,
    )
    print(f"{len(result.mesh.faces):,} faces, PSNR {result.metrics['psnr']:.1f} dB")
    print(f"page with everything: {etsplat.write_report(result.path)}")


if __name__ == "__main__":
    main()
