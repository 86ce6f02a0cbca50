"""What a run tells of its cameras."""

from dataclasses import dataclass


@dataclass(frozen=True)
class CamerasEvent:
    """Photos that are kept aside have judged a run with cameras as given, or one with refined cameras.

    After the first the run is back at `begin`, and makes the same steps again with refined cameras. After the second
    it goes on with what was better; if that are cameras as given, with the bits of a run that never refined them.

    Attributes:
        iteration: where the run stands now.
        begin: after this iteration cameras began to move.
        judged: iterations done when they were judged.
        given: PSNR of the photos that are kept aside, each from where the model fits it best, in dB: with cameras of
            training photos as given.
        refined: with refined ones; None if that is to come.
        stays: whether cameras stay refined; None likewise.

    Example:
        >>> event = etsplat.CamerasEvent(iteration=500, begin=500, judged=1000, given=24.31, refined=25.02, stays=True)
        >>> print(event)
        cameras: refined; the photos kept aside have 25.02 dB with refined ones, 24.31 dB as given
    """

    iteration: int
    begin: int
    judged: int
    given: float
    refined: float | None = None
    stays: bool | None = None

    @property
    def forgets(self) -> bool:
        """Whether what was logged after `begin` is not of the run that goes on."""
        return not self.stays

    def __str__(self) -> str:
        if self.refined is None:
            return (
                f"cameras: iterations {self.begin + 1:,} to {self.judged:,} come again, now with refined cameras; as "
                f"they were given, the photos kept aside have {self.given:.2f} dB"
            )
        found = f"the photos kept aside have {self.refined:.2f} dB with refined ones, {self.given:.2f} dB as given"
        return f"cameras: {'refined' if self.stays else 'kept as they were given'}; {found}"
