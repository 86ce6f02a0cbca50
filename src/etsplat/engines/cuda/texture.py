"""The GPU engine's side of `sample_texture`: csrc/cuda/texture.cu."""

import ctypes
from typing import Any

import torch
from torch import Tensor

from etsplat.engines.cuda.capacity import check_summed
from etsplat.engines.cuda.launch import launch_each
from etsplat.engines.cuda.program import Program
from etsplat.engines.cuda.structs import Struct, struct_class
from etsplat.engines.native.operation import differentiable
from etsplat.engines.native.texture import coarser_size

_PROGRAM = Program("texture.cu", contract=False)


def _forward(keep: bool, texture: Tensor, uv: Tensor, lod: Tensor | None, levels: int) -> tuple[Tensor, Any]:
    """With the coarser levels, which gradients by places take too."""
    if keep:
        check_summed("sample_texture", len(uv), 1)
    coarser = None if levels == 1 else texture.new_empty(coarser_size(texture, levels))
    described, samples = _problem(texture, coarser, levels, uv, lod)
    for level in range(1, levels):
        count = (texture.shape[0] >> level) * (texture.shape[1] >> level)
        launch_each(_PROGRAM, "texture_halve", count, (described, level, coarser))
    values = uv.new_empty((len(uv), texture.shape[2]))
    launch_each(_PROGRAM, "texture_sample", len(uv), (described, samples, values))
    return values, (texture, coarser, levels, uv, lod)


def _backward(kept: Any, needed: Any, grad_values: Tensor) -> tuple[Tensor | None, Tensor | None]:
    """By texels and places."""
    texture, coarser, _, uv, _ = kept
    described, samples = _problem(*kept)
    grad_texture = grad_uv = None
    if needed[0]:
        grad_texture, count = torch.empty_like(texture), grad_values.numel()
        base, above = (None if t is None else torch.zeros_like(t, dtype=torch.int64) for t in (texture, coarser))
        largest = torch.zeros(1, dtype=torch.int32, device=texture.device)
        launch_each(_PROGRAM, "texture_measure", count, (grad_values, ctypes.c_int64(count), largest))
        launch_each(_PROGRAM, "texture_scatter", len(uv), (described, samples, grad_values, largest, base, above))
        launch_each(_PROGRAM, "texture_gather", texture.numel(), (described, base, above, largest, grad_texture))
    if needed[1]:
        grad_uv = torch.empty_like(uv)
        launch_each(_PROGRAM, "texture_by_uv", len(uv), (described, samples, grad_values, grad_uv))
    return grad_texture, grad_uv


def _problem(
    texture: Tensor, coarser: Tensor | None, levels: int, uv: Tensor, lod: Tensor | None
) -> tuple[Struct, Struct]:
    """As the kernels read it, where its arrays lie now."""
    height, width, channels = texture.shape
    described = struct_class("math/texture.h", "Texture")(texture, coarser, width, height, channels, levels)
    return described, struct_class("cuda/texture.cu", "Samples")(uv, lod, len(uv))


sample_texture = differentiable(_forward, _backward)
