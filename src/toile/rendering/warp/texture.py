"""Stage 3, texture: bilinear lookup, clamped at the border."""

# Kernels are Python in syntax only: float(0.0) declares a variable that a loop may change, and arrays and
# numbers follow Warp's own typing rules.
# mypy: disable-error-code="arg-type, assignment, call-overload, index, misc, no-untyped-def, operator"

from typing import Any

import torch
import warp as wp
from torch import Tensor
from torch.autograd.function import once_differentiable

from toile.rendering.warp.arrays import launch, share, span

wp.set_module_options({"enable_backward": False})


@wp.func
def texel(coordinate: float, size: int):
    """Continuous index of a texture coordinate: texel centres lie at (i + 0.5) / size."""
    return wp.clamp(coordinate * float(size) - 0.5, 0.0, float(size) - 1.0)


@wp.kernel
def texture_kernel(
    uv: wp.array[wp.vec2],
    depth: wp.array[float],
    texture: wp.array[wp.vec3],
    texture_height: int,
    texture_width: int,
    n: int,
    span: int,
    rgb: wp.array[wp.vec3],
    silhouette: wp.array[float],
):
    """One thread per span of pixels."""
    part = wp.tid()
    for pixel in range(part * span, wp.min((part + 1) * span, n)):
        if depth[pixel] <= 0.0:
            rgb[pixel] = wp.vec3(0.0, 0.0, 0.0)
            silhouette[pixel] = 0.0
        else:
            at = uv[pixel]
            x = texel(at[0], texture_width)
            y = texel(at[1], texture_height)
            column = int(x)
            row = int(y)
            right = wp.min(column + 1, texture_width - 1)
            top = row * texture_width
            bottom = wp.min(row + 1, texture_height - 1) * texture_width
            s = x - float(column)
            r = y - float(row)
            above = texture[top + column] * (1.0 - s) + texture[top + right] * s
            below = texture[bottom + column] * (1.0 - s) + texture[bottom + right] * s
            rgb[pixel] = above * (1.0 - r) + below * r
            silhouette[pixel] = 1.0


@wp.kernel
def texture_backward_kernel(
    uv: wp.array[wp.vec2],
    depth: wp.array[float],
    texture: wp.array[wp.vec3],
    texture_height: int,
    texture_width: int,
    n: int,
    span: int,
    grad_rgb: wp.array[wp.vec3],
    grad_uv: wp.array[wp.vec2],
    with_texture: int,
    grad_texture: wp.array[wp.vec3],
):
    """Gradient to the coordinates, and to the texture if asked for."""
    part = wp.tid()
    for pixel in range(part * span, wp.min((part + 1) * span, n)):
        if depth[pixel] <= 0.0:
            grad_uv[pixel] = wp.vec2(0.0, 0.0)
        else:
            at = uv[pixel]
            x = texel(at[0], texture_width)
            y = texel(at[1], texture_height)
            column = int(x)
            row = int(y)
            right = wp.min(column + 1, texture_width - 1)
            top = row * texture_width
            bottom = wp.min(row + 1, texture_height - 1) * texture_width
            s = x - float(column)
            r = y - float(row)
            g = grad_rgb[pixel]
            c00 = wp.dot(texture[top + column], g)
            c01 = wp.dot(texture[top + right], g)
            c10 = wp.dot(texture[bottom + column], g)
            c11 = wp.dot(texture[bottom + right], g)
            # Where the index is clamped both texels coincide or the gradient is cut below.
            g_x = ((c01 - c00) * (1.0 - r) + (c11 - c10) * r) * float(texture_width)
            g_y = ((c10 - c00) * (1.0 - s) + (c11 - c01) * s) * float(texture_height)
            raw_x = at[0] * float(texture_width) - 0.5
            raw_y = at[1] * float(texture_height) - 0.5
            if raw_x < 0.0 or raw_x > float(texture_width) - 1.0:
                g_x = 0.0
            if raw_y < 0.0 or raw_y > float(texture_height) - 1.0:
                g_y = 0.0
            grad_uv[pixel] = wp.vec2(g_x, g_y)
            if with_texture != 0:
                wp.atomic_add(grad_texture, top + column, g * ((1.0 - s) * (1.0 - r)))
                wp.atomic_add(grad_texture, top + right, g * (s * (1.0 - r)))
                wp.atomic_add(grad_texture, bottom + column, g * ((1.0 - s) * r))
                wp.atomic_add(grad_texture, bottom + right, g * (s * r))


class Texture(torch.autograd.Function):
    """(uv, texture) -> colour and coverage of each pixel, before antialiasing."""

    @staticmethod
    def forward(ctx: Any, uv: Tensor, texture: Tensor, depth: Tensor) -> tuple[Tensor, Tensor]:
        """Look (h_t, w_t, 3) ``texture`` up at ``uv`` (B, h, w, 2), where ``depth`` (B, h, w) is positive."""
        rgb = torch.empty((*depth.shape, 3), device=uv.device)
        silhouette = torch.empty_like(depth)
        n = depth.numel()
        step = span(depth.shape[-1], uv.device)
        inputs = [
            share(uv, wp.vec2),
            share(depth, wp.float32),
            share(texture, wp.vec3),
            texture.shape[0],
            texture.shape[1],
            n,
            step,
            share(rgb, wp.vec3),
            share(silhouette, wp.float32),
        ]
        launch(texture_kernel, (-(-n // step),), inputs, uv.device)
        ctx.save_for_backward(uv, texture, depth)
        ctx.mark_non_differentiable(silhouette)
        return rgb, silhouette

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *grads: Any) -> Any:
        """Gradients to uv and to the texture."""
        uv, texture, depth = ctx.saved_tensors
        grad_uv = torch.empty_like(uv)
        with_texture = ctx.needs_input_grad[1]
        grad_texture = torch.zeros_like(texture) if with_texture else None
        n = depth.numel()
        step = span(depth.shape[-1], uv.device)
        inputs = [
            share(uv, wp.vec2),
            share(depth, wp.float32),
            share(texture, wp.vec3),
            texture.shape[0],
            texture.shape[1],
            n,
            step,
            share(grads[0].contiguous(), wp.vec3),
            share(grad_uv, wp.vec2),
            int(with_texture),
            share(texture if grad_texture is None else grad_texture, wp.vec3),
        ]
        launch(texture_backward_kernel, (-(-n // step),), inputs, uv.device)
        return grad_uv, grad_texture, None
