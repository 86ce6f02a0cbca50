"""`python -m studies`: which studies there are."""

from studies.distance import Distance
from studies.famous import Famous
from studies.figures import Figures
from studies.gallery import Gallery
from studies.nvs import Nvs
from studies.opensplat import OpenSplat
from studies.regularizers import Regularizers
from studies.settings import Settings
from studies.study import Study

STUDIES: tuple[type[Study], ...] = (Famous, Nvs, Regularizers, Distance, Settings, Gallery, Figures, OpenSplat)


def main() -> None:
    """Prints each with the first line of its help."""
    for study in STUDIES:
        print(f"{study.program():32} {(study.__doc__ or '').splitlines()[0]}")
    print("\nEach tells its options with --help.")


if __name__ == "__main__":
    main()
