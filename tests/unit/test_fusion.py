from __future__ import annotations

import numpy as np
import pytest

from ground_station.reconstruction.fusion import WEIGHT_MAX, Volume
from ground_station.reconstruction.surface_nets import extract_mesh
from ground_station.reconstruction.views import View
from protocol.errors import ReconstructionError
from protocol.geometry import Floats, Intrinsics, camera_rotation
from protocol.mission import Box

CAMERA = Intrinsics.from_field_of_view(96, 54, 1.287)
HEIGHT = 0.303
"""Of the fused plane, between two layers of voxels."""


@pytest.fixture
def volume() -> Volume:
    return Volume(Box(lower_m=(-1, -1, 0), upper_m=(1, 1, 1)), voxel_m=0.025, truncation_m=0.05)


def fuse_plane(volume: Volume, position: Floats, rotation: Floats, shade: int = 90, offset_m: float = 0.0) -> None:
    """Depth image of the plane z = HEIGHT, whose depth is wrong by ``offset_m``."""
    columns, rows = np.meshgrid(np.arange(CAMERA.width) + 0.5, np.arange(CAMERA.height) + 0.5)
    rays = np.stack([(columns - CAMERA.cx) / CAMERA.fx, (rows - CAMERA.cy) / CAMERA.fy, np.ones_like(rows)], axis=-1)
    depth = ((HEIGHT - position[2]) / (rays @ rotation.T)[..., 2] + offset_m).astype(np.float32)
    view = View(np.zeros(depth.shape, np.uint8), position, rotation, CAMERA)
    volume.integrate(view, depth, np.ones_like(depth), np.full((*depth.shape, 3), shade, np.uint8))


def test_a_plane_seen_from_two_poses_is_fused_within_a_sixth_of_a_voxel(volume: Volume) -> None:
    fuse_plane(volume, np.array([0.0, 0.0, 1.5]), camera_rotation(0.0, np.pi / 2))
    fuse_plane(volume, np.array([-0.4, 0.1, 1.4]), camera_rotation(0.3, 1.2))
    mesh = extract_mesh(volume, 0.5)
    assert np.ptp(mesh.vertices[:, 0]) > 1.0
    assert np.abs(mesh.vertices[:, 2] - HEIGHT).max() < 0.004
    assert np.abs(mesh.colors.astype(int) - 90).max() <= 1


def test_views_that_disagree_are_averaged_by_their_weight(volume: Volume) -> None:
    down = np.array([0.0, 0.0, 1.5]), camera_rotation(0.0, np.pi / 2)
    fuse_plane(volume, *down, offset_m=0.02)
    for _ in range(3):
        fuse_plane(volume, *down, offset_m=-0.02)
    mesh = extract_mesh(volume, 0.5)
    assert np.median(mesh.vertices[:, 2]) == pytest.approx(HEIGHT + 0.01, abs=0.002)


def test_space_seen_through_is_cleared_of_what_a_wrong_depth_put_there(volume: Volume) -> None:
    down = np.array([0.0, 0.0, 1.5]), camera_rotation(0.0, np.pi / 2)
    fuse_plane(volume, *down, offset_m=-0.3)
    assert extract_mesh(volume, 0.5).vertices[:, 2].max() > 0.5
    for _ in range(3):
        fuse_plane(volume, *down)
    assert extract_mesh(volume, 0.5).vertices[:, 2].max() < HEIGHT + 0.02


def test_nothing_behind_a_surface_or_outside_the_view_is_touched(volume: Volume) -> None:
    fuse_plane(volume, np.array([0.0, 0.0, 0.8]), camera_rotation(0.0, np.pi / 2))
    heights = volume.origin[2] + volume.voxel * np.arange(volume.weight.shape[2])
    assert volume.weight[:, :, heights < HEIGHT - 0.06].max() == 0
    assert volume.weight[0, :, :].max() == 0
    assert volume.weight[40:44, 40:44, (heights > HEIGHT) & (heights < 0.7)].min() == 1


def test_weights_saturate_so_that_the_map_can_follow_a_change(volume: Volume) -> None:
    for _ in range(int(WEIGHT_MAX) + 5):
        fuse_plane(volume, np.array([0.0, 0.0, 1.5]), camera_rotation(0.0, np.pi / 2))
    assert volume.weight.max() == WEIGHT_MAX


def test_a_depth_map_without_any_depth_changes_nothing(volume: Volume) -> None:
    view = View(np.zeros((54, 96), np.uint8), np.array([0.0, 0.0, 1.0]), camera_rotation(0.0, 1.5), CAMERA)
    volume.integrate(
        view, np.zeros((54, 96), np.float32), np.ones((54, 96), np.float32), np.zeros((54, 96, 3), np.uint8)
    )
    assert volume.weight.max() == 0


def test_a_volume_beyond_all_memory_is_refused_by_name() -> None:
    with pytest.raises(ReconstructionError, match="voxel_m"):
        Volume(Box(lower_m=(-50, -50, 0), upper_m=(50, 50, 20)), voxel_m=0.005, truncation_m=0.01)


def seen_from_two_poses(volume: Volume) -> None:
    fuse_plane(volume, np.array([0.0, 0.0, 1.5]), camera_rotation(0.0, np.pi / 2))
    fuse_plane(volume, np.array([-0.4, 0.1, 1.4]), camera_rotation(0.3, 1.2), shade=40, offset_m=0.013)


def test_a_volume_is_restored_bit_by_bit_and_smaller_than_it_is(volume: Volume) -> None:
    seen_from_two_poses(volume)
    state = volume.state()
    assert sum(array.nbytes for array in state.values()) < 0.5 * volume.size_bytes
    other = Volume(Box(lower_m=(-1, -1, 0), upper_m=(1, 1, 1)), voxel_m=0.025, truncation_m=0.05)
    fuse_plane(other, np.array([0.6, 0.0, 0.9]), camera_rotation(1.0, np.pi / 2))  # is forgotten
    other.restore(state)
    for one, two in ((volume.distance, other.distance), (volume.weight, other.weight), (volume.color, other.color)):
        np.testing.assert_array_equal(one, two)


def test_a_coloured_voxel_as_far_as_the_truncation_is_restored_with_its_colour(volume: Volume) -> None:
    volume.weight[3, 4, 5] = 1.0
    volume.distance[3, 4, 5] = volume.truncation
    volume.color[3, 4, 5] = (0, 0, 9)
    other = Volume(Box(lower_m=(-1, -1, 0), upper_m=(1, 1, 1)), voxel_m=0.025, truncation_m=0.05)
    other.restore(volume.state())
    assert other.color[3, 4, 5].tolist() == [0, 0, 9]
    assert other.distance[3, 4, 5] == np.float32(volume.truncation)


def test_a_state_does_not_change_when_the_map_goes_on(volume: Volume) -> None:
    seen_from_two_poses(volume)
    state = volume.state()
    before = {name: array.tobytes() for name, array in state.items()}
    seen_from_two_poses(volume)
    assert {name: array.tobytes() for name, array in state.items()} == before


def test_a_state_of_another_volume_is_refused(volume: Volume) -> None:
    state = volume.state()
    with pytest.raises(ReconstructionError, match="does not fit"):
        Volume(Box(lower_m=(-1, -1, 0), upper_m=(1, 1, 2)), voxel_m=0.025, truncation_m=0.05).restore(state)
    with pytest.raises(ReconstructionError, match="does not fit"):
        volume.restore({**state, "weight": np.ones(3, np.float32)})
