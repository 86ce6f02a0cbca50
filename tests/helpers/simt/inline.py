"""Programs whose text stands in a test."""

from dataclasses import dataclass

from etsplat.engines.cuda.program import Program


@dataclass(frozen=True, init=False)
class Inline(Program):
    """As if its source were a file of csrc/cuda."""

    text: str

    def __init__(self, text: str, contract: bool = True) -> None:
        super().__init__("inline.cu", contract=contract)
        object.__setattr__(self, "text", text)

    @property
    def source(self) -> str:
        """The text."""
        return self.text
