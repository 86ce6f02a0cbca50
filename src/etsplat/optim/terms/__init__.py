"""Terms of objectives: one module for each family. Those that are put into this folder are found by their names."""

import importlib
import pkgutil

from etsplat.optim.objective import Term


def named_terms() -> dict[str, type[Term]]:
    """Every term with a name, by it."""
    modules = [importlib.import_module(f"{__name__}.{module.name}") for module in pkgutil.iter_modules(__path__)]
    # By type(): on Python 3.10 `isinstance` takes an alias such as list[int] for a class.
    kinds = [kind for module in modules for kind in vars(module).values() if issubclass(type(kind), type)]
    return {kind.name: kind for kind in kinds if issubclass(kind, Term) and kind.name is not None}
