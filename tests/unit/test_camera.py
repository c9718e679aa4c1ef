import math
from dataclasses import replace

import numpy as np
import pytest

from protocol.depth_image import decode_depth
from protocol.geometry import Intrinsics, camera_rotation
from protocol.map_settings import Camera as CameraSettings
from protocol.map_settings import Reconstruction
from protocol.mission import Drone, Mission
from sim_bridge.camera import BACKGROUND, Camera, add_depth_noise, add_noise
from sim_bridge.photographer import Photographer
from sim_bridge.rasteriser import NEAR_M
from sim_bridge.scenes.scene import Scene, pack_scene
from sim_bridge.scenes.surfaces import Material, Surfaces, box, join, quad

INTRINSICS = Intrinsics.from_field_of_view(160, 90, math.radians(73.7))
GREY, RED = 0, 1
IMAGES = [np.full((4, 4, 3), 128, np.uint8), np.full((1, 1, 3), (250, 10, 10), np.uint8)]


def floor(half: float = 20.0, z: float = 0.0, material: Material | None = None) -> Surfaces:
    corners = [(-half, -half, z), (half, -half, z), (half, half, z), (-half, half, z)]
    return quad(corners, material or Material(GREY))


def camera(*parts: Surfaces, images: list[np.ndarray] | None = None) -> Camera:
    return Camera(scene(*parts, images=images), INTRINSICS)


def scene(*parts: Surfaces, images: list[np.ndarray] | None = None) -> Scene:
    return pack_scene(join(parts), images or IMAGES)


def rays(pose: tuple[float, ...]) -> np.ndarray:
    """World direction of each pixel's ray, scaled to 1 m along the optical axis, [H, W, 3]."""
    columns, rows = np.meshgrid(np.arange(INTRINSICS.width) + 0.5, np.arange(INTRINSICS.height) + 0.5)
    x, y = (columns - INTRINSICS.cx) / INTRINSICS.fx, (rows - INTRINSICS.cy) / INTRINSICS.fy
    return np.stack([x, y, np.ones_like(x)], -1) @ camera_rotation(pose[3], pose[4]).T


def floor_depth(pose: tuple[float, ...], z: float = 0.0) -> np.ndarray:
    down = rays(pose)[..., 2]
    return np.where(down < 0, (z - pose[2]) / np.where(down < 0, down, -1.0), np.inf)


def random_poses(count: int) -> list[tuple[float, ...]]:
    rng = np.random.default_rng(8)
    low, high = (-2, -2, 0.3, -math.pi, 0.2), (2, 2, 4, math.pi, math.pi / 2)
    return [tuple(rng.uniform(low, high)) for _ in range(count)]


def test_the_floor_seen_from_above_is_as_deep_as_the_camera_is_high() -> None:
    depth = camera(floor()).render_depth((0.3, -0.7, 2.0, 0.4, math.pi / 2))
    assert depth.dtype == np.float32
    assert depth.shape == (90, 160)
    assert np.abs(depth - 2.0).max() < 1e-5


@pytest.mark.parametrize("pose", random_poses(8))
def test_depth_of_a_tilted_view_of_the_floor_is_the_analytic_one(pose: tuple[float, ...]) -> None:
    expected = floor_depth(pose)
    near = expected < 15.0  # the floor ends at 20 m
    depth = camera(floor()).render_depth(pose)
    assert np.abs(depth[near] / expected[near] - 1).max() < 1e-5


def test_a_box_hides_the_floor_and_its_top_is_nearer_by_its_height() -> None:
    pose = (0.0, 0.0, 3.0, 0.0, math.pi / 2)
    depth = camera(floor(), box((1.0, 1.0, 1.0), Material(GREY))).render_depth(pose)
    reach = np.abs(rays(pose)[..., :2]) * 2.0
    on_top = (reach < 0.49).all(axis=-1)
    assert np.abs(depth[on_top] - 2.0).max() < 1e-5
    beside = (np.abs(rays(pose)[..., :2]) * 3.0 > 0.8).any(axis=-1)
    assert np.abs(depth[beside] - 3.0).max() < 1e-5


@pytest.mark.parametrize("pose", [(*pose[:4], max(pose[4], 0.7)) for pose in random_poses(6)])
def test_a_red_patch_appears_at_the_pixel_where_its_place_projects_to(pose: tuple[float, ...]) -> None:
    rotation = camera_rotation(pose[3], pose[4])
    # On the floor, a little off the middle of the image: a mirrored or turned image would not have it there.
    aim = rotation @ [0.25, 0.15, 1.0]
    place = np.array(pose[:3]) - aim * pose[2] / aim[2]
    size = 0.03 * pose[2]
    patch = quad(
        [(-size, -size, 1e-3), (size, -size, 1e-3), (size, size, 1e-3), (-size, size, 1e-3)], Material(RED)
    ).moved(place[0], place[1])
    image = camera(floor(), patch).render(pose)
    rows, columns = np.nonzero((image[..., 0] > 200) & (image[..., 1] < 60))
    x, y, z = rotation.T @ (place - pose[:3])
    assert columns.mean() + 0.5 == pytest.approx(INTRINSICS.fx * x / z + INTRINSICS.cx, abs=0.6)
    assert rows.mean() + 0.5 == pytest.approx(INTRINSICS.fy * y / z + INTRINSICS.cy, abs=0.6)


def test_the_same_pose_gives_the_same_bytes_from_any_camera() -> None:
    parts = (floor(), box((1.0, 0.6, 0.8), Material(RED)), box((0.4, 0.4, 1.4), Material(GREY), (0.9, 0.2, 0.0)))
    first, second = camera(*parts), camera(*parts)
    for pose in random_poses(3):
        image, depth = first.render(pose).tobytes(), first.render_depth(pose).tobytes()
        first.render((0, 0, 1, 1, 1))
        assert first.render(pose).tobytes() == image == second.render(pose).tobytes()
        assert first.render_depth(pose).tobytes() == depth


def test_triangles_that_reach_behind_the_camera_are_drawn_up_to_the_near_plane() -> None:
    # Two triangles of 40 m, the camera in the middle of them, looking at the horizon.
    pose = (0.5, 0.2, 0.6, 0.3, 0.0)
    expected = floor_depth(pose)
    depth = camera(floor()).render_depth(pose)
    near = expected < 15.0
    assert near.any()
    assert np.abs(depth[near] / expected[near] - 1).max() < 1e-5
    assert np.isinf(depth[np.isinf(expected)]).all()


def test_what_is_nearer_than_the_near_plane_is_not_drawn() -> None:
    facing = Material(RED, two_sided=True)
    seen = camera(floor(1.0, 0.0, facing)).render_depth((0, 0, NEAR_M + 0.01, 0, math.pi / 2))
    unseen = camera(floor(1.0, 0.0, facing)).render_depth((0, 0, NEAR_M - 0.01, 0, math.pi / 2))
    assert np.isfinite(seen).all()
    assert np.isinf(unseen).all()


def test_a_slanted_triangle_is_cut_at_the_near_plane_and_nowhere_else() -> None:
    pose = (0.0, 0.0, 0.045, 0.0, 1.0)
    expected = floor_depth(pose)
    depth = camera(floor()).render_depth(pose)
    margin = 1e-4
    assert np.isinf(depth[expected < NEAR_M - margin]).all()
    beyond = (expected > NEAR_M + margin) & (expected < 15.0)
    assert (expected < NEAR_M - margin).any()
    assert np.abs(depth[beyond] / expected[beyond] - 1).max() < 1e-5


def test_the_back_of_a_one_sided_surface_is_not_drawn_but_that_of_a_two_sided_is() -> None:
    from_below = (0.0, 0.0, -1.0, 0.0, -math.pi / 2)
    assert (camera(floor()).render(from_below) == BACKGROUND).all()
    assert (camera(floor(material=Material(RED, two_sided=True))).render(from_below) == (250, 10, 10)).all()


def test_a_floor_of_ten_thousand_uneven_triangles_has_no_holes_and_is_culled_rightly() -> None:
    rng = np.random.default_rng(3)
    steps = np.linspace(-6, 6, 71)
    x, y = np.meshgrid(steps, steps)
    inner = (slice(1, -1), slice(1, -1))
    x[inner] += rng.uniform(-0.08, 0.08, x[inner].shape)
    y[inner] += rng.uniform(-0.08, 0.08, y[inner].shape)
    grid = np.stack([x, y, np.zeros_like(x)], axis=-1)
    a, b, c, d = (part.reshape(-1, 3) for part in (grid[:-1, :-1], grid[:-1, 1:], grid[1:, 1:], grid[1:, :-1]))
    triangles = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])
    count = len(triangles)
    texture, two_sided = np.zeros(count, np.int32), np.zeros(count, bool)
    uneven = Surfaces(triangles, np.zeros((count, 3, 2)), np.ones((count, 3, 3)), texture, two_sided)
    cam = camera(uneven)
    for pose in random_poses(12):
        expected = floor_depth(pose)
        there = np.array(pose[:2]) + rays(pose)[..., :2] * np.where(np.isfinite(expected), expected, 1e3)[..., None]
        inside = (np.abs(there) < 5.9).all(axis=-1)
        depth = cam.render_depth(pose)
        assert np.abs(depth[inside] / expected[inside] - 1).max(initial=0.0) < 1e-5


def test_the_middle_of_each_texel_shows_the_textures_colour() -> None:
    rng = np.random.default_rng(4)
    picture = rng.integers(0, 256, (4, 8, 3), dtype=np.uint8)
    # 8 x 4 texels of 0.1 m; seen from above with yaw pi/2, north is up in the image.
    ground = quad([(-0.4, -0.2, 0), (0.4, -0.2, 0), (0.4, 0.2, 0), (-0.4, 0.2, 0)], Material(0), (0, 0, 1, 1))
    pose = (0.0, 0.0, 0.6, math.pi / 2, math.pi / 2)
    image = camera(ground, images=[picture]).render(pose)
    for row in range(4):
        for column in range(8):
            x, y = (column + 0.5) * 0.1 - 0.4, 0.2 - (row + 0.5) * 0.1
            pixel_x, pixel_y = INTRINSICS.fx * x / 0.6 + INTRINSICS.cx, -INTRINSICS.fy * y / 0.6 + INTRINSICS.cy
            seen = image[int(pixel_y), int(pixel_x)].astype(int)
            assert np.abs(seen - picture[row, column]).max() <= 14  # a pixel's centre may be 0.5 px off the texel's


def test_a_texture_on_a_tilted_floor_is_perspective_correct() -> None:
    ramp = np.repeat(np.arange(256, dtype=np.uint8)[None, :, None], 256, axis=0).repeat(3, axis=2)
    ground = quad([(-4, -4, 0), (4, -4, 0), (4, 4, 0), (-4, 4, 0)], Material(0), (0, 0, 1, 1))
    pose = (0.0, -3.0, 1.0, math.pi / 2, math.radians(30))
    image = camera(ground, images=[ramp]).render(pose)[..., 0].astype(float)
    place = rays(pose) * floor_depth(pose)[..., None] + pose[:3]
    inside = (np.abs(place[..., :2]) < 3.5).all(axis=-1)
    expected = (place[..., 0] + 4) / 8 * 256 - 0.5
    assert inside.sum() > 5000
    assert np.abs(image - expected)[inside].max() < 2.5


def test_a_texture_finer_than_the_pixels_is_averaged() -> None:
    checks = np.indices((256, 256)).sum(axis=0) % 2 * 255
    picture = np.repeat(checks[..., None], 3, axis=2).astype(np.uint8)
    ground = floor(4.0, material=Material(0, tile_m=0.5))
    image = camera(ground, images=[picture]).render((0, 0, 3.0, 0.3, math.pi / 2)).astype(int)
    assert np.abs(image - 128).max() <= 1


def test_light_scales_the_texture() -> None:
    lit = replace(floor(), colour=np.broadcast_to((0.5, 1.0, 3.0), (2, 3, 3)))
    image = camera(lit).render((0, 0, 2.0, 0, math.pi / 2))
    assert (image == (64, 128, 255)).all()


def test_noise_has_the_wished_deviation_and_follows_its_generator() -> None:
    image = np.full((90, 160, 3), 100, np.uint8)
    rng = np.random.default_rng(1)
    first, second = add_noise(image, 2.0, rng), add_noise(image, 2.0, rng)
    difference = first.astype(int) - 100
    assert abs(difference.mean()) < 0.05
    assert difference.std() == pytest.approx(math.hypot(2.0, 1 / math.sqrt(12)), rel=0.02)
    assert not np.array_equal(first, second)
    assert np.array_equal(first, add_noise(image, 2.0, np.random.default_rng(1)))
    left, right = difference[:, :-1].ravel(), difference[:, 1:].ravel()
    assert abs(np.corrcoef(left, right)[0, 1]) < 0.02


def test_noise_is_clipped_and_zero_noise_changes_nothing() -> None:
    rng = np.random.default_rng(1)
    assert (add_noise(np.zeros((40, 40, 3), np.uint8), 5.0, rng) < 40).all()
    assert (add_noise(np.full((40, 40, 3), 255, np.uint8), 5.0, rng) > 215).all()
    image = np.full((40, 40, 3), 7, np.uint8)
    assert np.array_equal(add_noise(image, 0.0, rng), image)


def test_noise_of_depth_grows_with_its_square_and_leaves_nothing_where_nothing_is() -> None:
    near, far = np.full((200, 200), 0.5, np.float32), np.full((200, 200), 3.0, np.float32)
    far[0] = np.inf
    noisy = [add_depth_noise(depth, 0.002, 0.003, np.random.default_rng(2)) for depth in (near, far)]
    assert noisy[0].dtype == np.float32
    assert noisy[0].std() == pytest.approx(0.002 + 0.003 * 0.25, rel=0.02)
    assert noisy[1][1:].std() == pytest.approx(0.002 + 0.003 * 9, rel=0.02)
    assert noisy[1][1:].mean() == pytest.approx(3.0, abs=0.001)
    assert np.isposinf(noisy[1][0]).all()
    again = add_depth_noise(far, 0.002, 0.003, np.random.default_rng(2))
    np.testing.assert_array_equal(again, noisy[1])
    assert add_depth_noise(near, 0.0, 0.0, np.random.default_rng(2)) is near


def test_a_drone_with_a_depth_camera_measures_what_its_camera_sees() -> None:
    mission = Mission(
        camera=CameraSettings(width_px=160, height_px=90, depth=True),
        reconstruction=Reconstruction(sweep_width_px=64),
        drones=(Drone(id=1, start=(0, 0, 2, 0, 1.4)),),
    )
    room = scene(floor())
    cameras = Camera(room, mission.camera.intrinsics()), Camera(room, mission.sweep_intrinsics())
    kept = []
    for _ in range(2):
        photographer = Photographer(mission, *cameras)
        (shot,) = photographer.due(4, {1: np.array([0.0, 0.0, 2.0, 0.3, math.pi / 2])})
        kept.append(photographer.take(shot))
    assert kept[0] == kept[1], "the same seed, the same bytes"
    depth = decode_depth(kept[0].depth, 160, 90)
    assert depth.shape == (36, 64)
    assert depth.mean() == pytest.approx(2.0, abs=0.002)
    assert 0.01 < depth.std() < 0.02
    assert Photographer(mission, cameras[0]).take(shot).depth == b""
