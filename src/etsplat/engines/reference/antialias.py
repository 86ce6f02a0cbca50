"""Antialiased z-buffer rasterization in plain PyTorch: all pixels, and all pairs of pixels, at once."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from etsplat.core.connectivity import MeshConnectivity
from etsplat.engines.reference.rasterize import cross, to_screen


def antialias(
    vertices: Tensor,
    colors: Tensor,
    backgrounds: Tensor,
    viewmats: Tensor,
    Ks: Tensor,
    triangle: Tensor,
    barycentrics: Tensor,
    depth: Tensor,
    near_plane: float,
    per_face: bool,
    connectivity: MeshConnectivity,
) -> Tensor:
    """Shade and blend what `rasterize_opaque` has seen: (B, H, W, C)."""
    faces, images = connectivity.faces.long(), []
    for b, (viewmat, K) in enumerate(zip(viewmats.detach(), Ks.detach(), strict=True)):
        screen, z = to_screen(vertices, viewmat, K)
        drawn = ((z > near_plane) & screen.isfinite().all(dim=1)).detach()
        row, column = (triangle[b] >= 0).nonzero(as_tuple=True)
        owner = triangle[b, row, column].long()
        if per_face:
            values = colors[owner]
        else:
            corners = vertices[faces[owner]] @ viewmat[:3, :3].T + viewmat[:3, 3]
            pixels = torch.stack([column + 0.5, row + 0.5, torch.ones_like(row)], dim=1).to(vertices.dtype)
            rays = torch.linalg.solve(K, pixels.T).T
            # The point b_0 v_0 + b_1 v_1 + b_2 v_2 lies on the ray.
            beta = torch.linalg.solve(corners.mT, rays[..., None])[..., 0]
            values = ((beta / beta.sum(dim=1, keepdim=True))[..., None] * colors[faces[owner]]).sum(dim=1)
        image = shaded = backgrounds[b].expand(*triangle[b].shape, -1).index_put((row, column), values)
        silhouette = _silhouettes(connectivity, screen.detach(), drawn)
        for axis in range(2):
            image = image + _blends(shaded, screen, silhouette, faces, triangle[b], depth[b], axis)
        images.append(image)
    return torch.stack(images) if images else vertices.new_zeros(*triangle.shape, colors.shape[1])


def _silhouettes(connectivity: MeshConnectivity, screen: Tensor, drawn: Tensor) -> Bool[Tensor, "F 3"]:
    """Whether the edge from corner k to k + 1 of each face has no drawn face on its other side."""
    faces = connectivity.faces.long()
    silhouette = torch.ones(faces.shape, dtype=torch.bool, device=faces.device)
    pairs = connectivity.face_pairs.long()
    for own, other in (pairs.unbind(1), pairs.flip(1).unbind(1)):
        usable = drawn[faces[other]].all(dim=1)
        for k in range(3):
            a, b, c = (faces[own, (k + i) % 3] for i in range(3))
            for j in range(3):
                p, q, opposite = (faces[other, (j + i) % 3] for i in range(3))
                shared = ((p == a) & (q == b)) | ((p == b) & (q == a))
                edge = screen[b] - screen[a]
                own_side, other_side = (cross(edge, screen[corner] - screen[a]) for corner in (c, opposite))
                across = own_side * other_side < 0
                silhouette[own[shared & usable & across], k] = False
    return silhouette


def _blends(
    shaded: Tensor, screen: Tensor, silhouette: Tensor, faces: Tensor, triangle: Tensor, depth: Tensor, axis: int
) -> Float[Tensor, "H W C"]:
    """What the pixels get through the silhouettes between horizontal (axis 0) or vertical (axis 1) neighbours."""
    height, width = triangle.shape
    size = (height, width - 1) if axis == 0 else (height - 1, width)
    y, x = (triangle[: size[0], : size[1]] != triangle[height - size[0] :, width - size[1] :]).nonzero(as_tuple=True)
    pixel = torch.stack([y * width + x, (y + axis) * width + x + 1 - axis])  # (2, pairs)
    owner, z = triangle.reshape(-1)[pixel].long(), depth.reshape(-1)[pixel]
    forward = (owner[1] < 0) | ((owner[0] >= 0) & (z[0] <= z[1]))
    nearer = torch.where(forward, owner[0], owner[1])
    result = torch.zeros_like(shaded).reshape(height * width, -1)
    for k in range(3):
        a, b = screen[faces[nearer, k]], screen[faces[nearer, (k + 1) % 3]]
        across = (y if axis == 0 else x) + 0.5
        crosses = (a[:, 1 - axis] <= across) != (b[:, 1 - axis] <= across)
        use = (silhouette[nearer, k] & crosses).nonzero()[:, 0]
        slope = (b[use, axis] - a[use, axis]) / (b[use, 1 - axis] - a[use, 1 - axis])
        position = a[use, axis] + (across[use] - a[use, 1 - axis]) * slope
        start = (x if axis == 0 else y)[use] + torch.where(forward[use], 0.5, 1.5)
        reach = torch.where(forward[use], position - start, start - position)
        keep = (slope.detach().abs() <= 1) & (reach.detach() >= 0) & (reach.detach() <= 1)
        use, reach = use[keep], reach[keep]
        overruns = reach.detach() > 0.5
        target = torch.where(overruns == forward[use], 1, 0)
        to, source = pixel[target, use], pixel[1 - target, use]
        flat = shaded.reshape(height * width, -1)
        result = result.index_add(0, to, (reach - 0.5).abs()[:, None] * (flat[source] - flat[to]))
    return result.reshape(shaded.shape)
