"""Calls on an engine, whose device the test need not know."""

from collections.abc import Callable
from dataclasses import fields, is_dataclass
from typing import Any

import pytest
import torch
from torch import Tensor

import etsplat
from etsplat.core.rasterization import Rasterization, RasterizeSettings, RasterizeTensors
from etsplat.engines import choice
from etsplat.engines.cpu.engine import CpuEngine
from etsplat.engines.cuda.launch import device_type


def on(engine: str | None, function: Callable[..., Any], *arguments: Any, **named: Any) -> Any:
    """Calls the function on an engine: tensors go to its device, results come back, gradients with them."""
    there = device_of(engine)
    with etsplat.engine(engine):
        result = function(*moved(arguments, there), **moved(named, there))
    return moved(result, "cpu")


class Noted(CpuEngine):
    """Engine "cpu" by another name, which counts its pictures."""

    name = "noted"
    device = None

    def __init__(self) -> None:
        self.pictures = 0

    def rasterize(self, tensors: RasterizeTensors, settings: RasterizeSettings) -> Rasterization:
        self.pictures += 1
        return super().rasterize(tensors, settings)


def noted_engine(monkeypatch: pytest.MonkeyPatch) -> Noted:
    """One that is registered as long as the test runs."""
    monkeypatch.setattr(choice, "_engines", dict(choice._engines))
    noted = Noted()
    etsplat.register_engine(noted)
    return noted


def looking(engine: str) -> dict[str, bool]:
    """What makes `rasterize` look at values, as it does by itself where they are on the CPU."""
    return {"validate": True} if device_of(engine) == "cuda" else {}


def device_of(engine: str | None) -> str:
    return device_type() if engine == "cuda" else "cpu"


def dtype_of(engine: str) -> torch.dtype:
    return torch.float64 if engine == "reference" else torch.float32


def moved(value: Any, device: str) -> Any:
    """The tensors in it on the device: also those in tuples, lists, dictionaries and dataclasses."""
    if isinstance(value, Tensor):
        return value.to(device)
    if isinstance(value, dict):
        return {name: moved(item, device) for name, item in value.items()}
    if isinstance(value, tuple) and hasattr(value, "_fields"):
        return type(value)(*(moved(item, device) for item in value))
    if isinstance(value, list | tuple):
        return type(value)(moved(item, device) for item in value)
    if is_dataclass(value) and not isinstance(value, type):
        return type(value)(**{field.name: moved(getattr(value, field.name), device) for field in fields(value)})
    return value
