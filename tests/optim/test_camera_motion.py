"""Motions of cameras: what they are, in which units they are learned, and what moves all cameras alike."""

import math

import pytest
import torch

import etsplat
from etsplat.optim.camera_motion import DAMPING, common_motions, distance_shown, moved, unit_motions, zoomed
from helpers.torch_threads import on_each_count

CAMERAS = etsplat.orbit_cameras(100, 80, elevations=(10.0, 40.0), azimuths=3).to(dtype=torch.float64)


def points(count: int = 400) -> torch.Tensor:
    """In the frames of all cameras."""
    generator = torch.Generator().manual_seed(1)
    return 0.4 * (torch.rand(count, 3, generator=generator, dtype=torch.float64) - 0.5)


def pixels(camera: etsplat.Cameras, at: torch.Tensor) -> torch.Tensor:
    seen = (at @ camera.viewmats[0, :3, :3].T + camera.viewmats[0, :3, 3]) @ camera.Ks[0].T
    return seen[:, :2] / seen[:, 2:]


def test_a_motion_turns_about_the_camera_and_then_shifts_it() -> None:
    """By the angle and along the axes that it says; a rotation stays one."""
    camera, motion = CAMERAS[1], torch.tensor([0.0, 0.3, 0.0, 0.1, 0.2, -0.3], dtype=torch.float64)
    there = moved(camera, motion)
    rotation = camera.viewmats[0, :3, :3]
    torch.testing.assert_close(there.centers[0], camera.centers[0] + rotation.T @ motion[3:])
    turn = there.viewmats[0, :3, :3] @ rotation.T
    torch.testing.assert_close(turn @ turn.T, torch.eye(3, dtype=torch.float64))
    angle = 2 * math.atan(0.15)
    expected = [[math.cos(angle), 0, math.sin(angle)], [0, 1, 0], [-math.sin(angle), 0, math.cos(angle)]]
    torch.testing.assert_close(turn, torch.tensor(expected, dtype=torch.float64))


def test_no_motion_leaves_the_camera_and_has_a_gradient() -> None:
    """At zero too, where an angle would have none."""
    motion = torch.zeros(6, dtype=torch.float64, requires_grad=True)
    assert torch.equal(moved(CAMERAS[0], motion).viewmats, CAMERAS[0].viewmats)
    assert torch.autograd.gradcheck(lambda m: moved(CAMERAS[0], m).viewmats, (motion,))


def test_lenses_zoom_and_shift() -> None:
    """Focal lengths by a factor, the middle by parts of the longer side."""
    lens = torch.tensor([0.1, 0.02, -0.03], dtype=torch.float64)
    K, given = zoomed(CAMERAS[0], lens).Ks[0], CAMERAS[0].Ks[0]
    assert float(K[0, 0] / given[0, 0]) == pytest.approx(math.exp(0.1))
    assert float(K[1, 1] / given[1, 1]) == pytest.approx(math.exp(0.1))
    torch.testing.assert_close(K[:2, 2] - given[:2, 2], torch.tensor([2.0, -3.0], dtype=torch.float64))
    assert K[2].tolist() == [0, 0, 1]
    assert torch.autograd.gradcheck(lambda x: zoomed(CAMERAS[0], x).Ks, (lens.requires_grad_(),))


def test_units_move_pictures_alike_in_all_directions() -> None:
    """Of the second moments of how pixels move, beside a derivative by torch."""
    camera, at = CAMERAS[2], points()
    J = torch.autograd.functional.jacobian(lambda m: pixels(moved(camera, m), at), torch.zeros(6, dtype=torch.float64))
    assert isinstance(J, torch.Tensor)
    J = J.reshape(-1, 6) / 100
    H = 2 * J.T @ J / len(J)
    H = H + DAMPING * torch.diag(H.diagonal())
    unit = unit_motions(at, camera)
    torch.testing.assert_close(unit @ H @ unit, torch.eye(6, dtype=torch.float64))


def test_units_without_points_are_those_of_the_distance_from_the_origin() -> None:
    """Nothing fails, and twice the distance makes shifts twice as large."""
    near, behind = CAMERAS[0], 1e3 * CAMERAS[0].centers
    far = near.viewmats.clone()
    far[:, :3, 3] *= 2
    away = etsplat.Cameras(far, near.Ks, near.width, near.height)
    shifts = [float(unit_motions(2 * behind, camera)[5, 5]) for camera in (near, away)]
    assert shifts[1] == pytest.approx(2 * shifts[0])
    assert distance_shown(2 * behind, away) == pytest.approx(2 * distance_shown(2 * behind, near))


def test_what_moves_all_cameras_alike_is_in_the_basis() -> None:
    """Seven directions; those of a small similarity to first order, those of one camera alone not."""
    units = torch.stack([unit_motions(points(), camera) for camera in (CAMERAS[i] for i in range(6))])
    basis = common_motions(CAMERAS.viewmats, units)
    assert basis.shape == (36, 7)
    torch.testing.assert_close(basis.T @ basis, torch.eye(7, dtype=torch.float64))
    small = 1e-5
    turn = torch.linalg.matrix_exp(small * torch.tensor([[0, -1, 0.3], [1, 0, 0.2], [-0.3, -0.2, 0]]).double())
    centers = (1 + 2 * small) * CAMERAS.centers @ turn.T + small * torch.tensor([0.3, 0.1, -0.5]).double()
    learned = []
    for view in range(6):
        rotation = CAMERAS.viewmats[view, :3, :3]
        between = rotation @ turn.T @ rotation.T
        axis = torch.stack(
            [between[2, 1] - between[1, 2], between[0, 2] - between[2, 0], between[1, 0] - between[0, 1]]
        )
        motion = torch.cat([axis / 2, rotation @ (centers[view] - CAMERAS.centers[view])])
        learned.append(torch.linalg.solve(units[view], motion))
    together = torch.cat(learned)
    assert float((together - basis @ (basis.T @ together)).norm() / together.norm()) < 1e-3
    alone = torch.cat([learned[0], torch.zeros(30, dtype=torch.float64)])
    assert float((alone - basis @ (basis.T @ alone)).norm() / alone.norm()) > 0.5


def test_the_basis_has_equal_bits_on_any_number_of_torchs_threads() -> None:
    cameras = etsplat.orbit_cameras(100, 80, elevations=(10.0, 40.0), azimuths=20).to(dtype=torch.float64)
    units = torch.stack([unit_motions(points(), cameras[i]) for i in range(len(cameras))])
    first, *others = on_each_count(lambda: common_motions(cameras.viewmats, units))
    assert all(torch.equal(first, other) for other in others)
