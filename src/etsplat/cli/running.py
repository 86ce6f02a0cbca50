"""What the commands that make a run have in common: options, progress, report, summary, and how a run ends early."""

from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, ClassVar, TypedDict

from etsplat.cli.command import FAILED, INTERRUPTED, Command, Flag, fail, resume_line
from etsplat.tasks.settings import Rare

if TYPE_CHECKING:
    from etsplat.cli.progress import RunProgress


class Place(TypedDict):
    """What a task does with an earlier run in its folder."""

    resume: bool
    overwrite: bool


@dataclass(frozen=True, kw_only=True)
class RunCommand(Command):
    """Base of the commands that make a run."""

    PREPARING: ClassVar[str]
    """What happens before the first step."""

    help_all: Flag = False
    """Show every option, and every setting under its heading."""
    debug: Annotated[Flag, Rare] = False
    """Show the traceback of an error."""
    out: Path
    """Folder for the results."""
    config: Path | None = None
    """Settings to begin with: config.json of a run, or a JSON file with some of them. Options go over it."""
    kernel_file: Annotated[Path | None, Rare] = None
    """A Python file that registers the kernel named by --method (etsplat.register_kernel). It is run."""
    overwrite: Flag = False
    """Replace an earlier run in the folder."""
    resume: Flag = False
    """Continue an interrupted run in the folder; give the same options as then."""

    @property
    def place(self) -> Place:
        """For the task."""
        return {"resume": self.resume, "overwrite": self.overwrite}

    @abstractmethod
    def task(self, progress: "RunProgress") -> None:
        """Makes the run in `out`, with the bar as one of its callbacks."""

    def run(self, arguments: Sequence[str]) -> int:
        """Does the run with a progress bar, writes its report and prints what came out."""
        from rich.console import Console

        from etsplat.cli.progress import RunProgress
        from etsplat.cli.summary import print_summary
        from etsplat.io.run_directory import is_run
        from etsplat.optim.loop import DivergedError
        from etsplat.report import write_report

        console = Console()
        try:
            with RunProgress(console, preparing=self.PREPARING) as progress:
                self.task(progress)
                progress.say("Writing the report")
                write_report(self.out)
        except KeyboardInterrupt:
            if not is_run(self.out):
                raise
            fail(f"interrupted; continue with: {resume_line(arguments)}", INTERRUPTED)
        except DivergedError as error:
            if self.debug:
                raise
            fail(str(error), FAILED)
        print_summary(console, self.out)
        return 0
