"""The map in blocks, from the ground station that cuts it to the console that puts it together."""

import numpy as np
import pytest

from ground_station.console.mesh_cache import MeshCache
from ground_station.mesh_blocks import PAGE_BLOCKS, MeshBlocks
from ground_station.reconstruction.reconstructor import Mesh
from protocol.messages import MeshBlock, MeshPage
from protocol.wire import decode, encode


def sheet(width_m: float, pitch_m: float = 0.1, dent: tuple[float, float] | None = None) -> Mesh:
    """A square in the plane z = 0.5 with its corner at the origin; with a dent of 5 cm at one place."""
    ticks = np.arange(round(width_m / pitch_m) + 1) * pitch_m
    x, y = np.meshgrid(ticks, ticks, indexing="ij")
    vertices = np.stack([x.ravel(), y.ravel(), np.full(x.size, 0.5)], axis=1).astype(np.float32)
    if dent is not None:
        vertices[np.linalg.norm(vertices[:, :2] - dent, axis=1) < pitch_m, 2] -= 0.05
    number = np.arange(x.size).reshape(x.shape)
    a, b, c, d = (part.ravel() for part in (number[:-1, :-1], number[1:, :-1], number[1:, 1:], number[:-1, 1:]))
    faces = np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)]).astype(np.int32)
    return Mesh(vertices, faces, (50 * vertices).astype(np.uint8))


def triangles(*parts: Mesh | MeshBlock) -> list[list[float]]:
    """Corners and colours of every face, in an order of their own."""
    rows = []
    for part in parts:
        colours = part.colors if isinstance(part, Mesh) else part.colours
        corners, shades = part.vertices[part.faces].reshape(-1, 9), colours[part.faces].reshape(-1, 9)
        rows += np.concatenate([corners, shades], axis=1).tolist()
    return sorted(rows)


def watch(cache: MeshCache, blocks: MeshBlocks, limit_bytes: int = 2**20) -> int:
    """Ask as a console does, until there is no more; how many pages."""
    for pages in range(1, 1000):
        since, epoch = (int(part.split("=")[1]) for part in cache.parameters.split(";"))
        page = decode(MeshPage, encode(blocks.page(since, epoch, limit_bytes)))
        if cache.take(page).complete:
            return pages
    raise AssertionError("no end of pages")


def test_blocks_hold_every_face_once_in_the_cube_of_its_centre() -> None:
    mesh = sheet(3.0)
    blocks = MeshBlocks()
    assert blocks.update(mesh) == 9
    page = blocks.page()
    assert page.complete
    assert triangles(*page.blocks) == triangles(mesh)
    for block in page.blocks:
        centres = block.vertices[block.faces].mean(axis=1)
        assert (np.floor(centres) == block.key).all()
        assert len(np.unique(block.faces)) == len(block.vertices), "a vertex that no face uses"


def test_blocks_lie_on_both_sides_of_the_origin() -> None:
    mesh = sheet(2.0)
    blocks = MeshBlocks()
    blocks.update(Mesh(mesh.vertices - np.float32(1), mesh.faces, mesh.colors))
    assert {block.key for block in blocks.page().blocks} == {(x, y, -1) for x in (-1, 0) for y in (-1, 0)}


def test_only_the_blocks_that_changed_are_told_again() -> None:
    blocks = MeshBlocks()
    blocks.update(sheet(4.0))
    before = blocks.page()
    assert blocks.update(sheet(4.0, dent=(2.5, 1.5))) == 1
    page = blocks.page(before.revision, before.epoch)
    assert [block.key for block in page.blocks] == [(2, 1, 0)]
    assert page.revision == blocks.revision > before.revision


def test_what_lies_elsewhere_in_the_mesh_does_not_change_a_block() -> None:
    near, far = sheet(1.0), sheet(1.0)
    blocks = MeshBlocks()
    blocks.update(near)
    first = blocks.revision
    both = Mesh(
        np.concatenate([far.vertices + np.float32(5), near.vertices]),
        np.concatenate([far.faces, near.faces + np.int32(len(far.vertices))]),
        np.concatenate([far.colors, near.colors]),
    )
    assert blocks.update(both) == 1
    assert [block.key for block in blocks.page(first, blocks.epoch).blocks] == [(5, 5, 5)]


def test_the_same_map_again_changes_nothing() -> None:
    blocks = MeshBlocks()
    blocks.update(sheet(2.0))
    revision = blocks.revision
    assert blocks.update(sheet(2.0)) == 0
    page = blocks.page(revision, blocks.epoch)
    assert (page.blocks, page.complete, page.revision) == ((), True, revision)


def test_a_block_that_vanishes_is_told_as_empty_once() -> None:
    blocks = MeshBlocks()
    blocks.update(sheet(2.0))
    seen = blocks.revision
    assert blocks.update(sheet(1.0)) == 3
    gone = blocks.page(seen, blocks.epoch)
    assert {block.key: len(block.faces) for block in gone.blocks} == {(0, 1, 0): 0, (1, 0, 0): 0, (1, 1, 0): 0}
    assert blocks.update(sheet(1.0)) == 0
    assert blocks.update(Mesh.empty()) == 1


@pytest.mark.parametrize("limit_bytes", [1, 20_000, 10**9])
def test_a_console_has_the_whole_map_whatever_the_size_of_a_page(limit_bytes: int) -> None:
    blocks, cache = MeshBlocks(), MeshCache()
    for mesh in (sheet(2.0), sheet(4.0), sheet(4.0, dent=(0.5, 0.5)), sheet(3.0)):
        blocks.update(mesh)
        pages = watch(cache, blocks, limit_bytes)
        assert pages == 1 or limit_bytes < 10**9
        assert triangles(*cache.blocks.values()) == triangles(mesh)
    assert cache.refused == 0


def test_a_page_has_no_more_blocks_than_a_message_has_members() -> None:
    blocks = MeshBlocks(block_m=0.1)
    blocks.update(sheet(4.0, pitch_m=0.1))
    page = blocks.page()
    assert len(page.blocks) == PAGE_BLOCKS
    assert not page.complete
    assert decode(MeshPage, encode(page)).revision == page.revision
    assert watch(MeshCache(), blocks) == 2


def test_a_change_between_two_pages_is_not_missed() -> None:
    blocks, cache = MeshBlocks(), MeshCache()
    blocks.update(sheet(3.0))
    assert not cache.take(blocks.page(limit_bytes=1)).complete
    blocks.update(sheet(3.0, dent=(0.5, 0.5)))
    watch(cache, blocks, limit_bytes=1)
    assert triangles(*cache.blocks.values()) == triangles(sheet(3.0, dent=(0.5, 0.5)))


def test_two_ground_stations_number_alike_but_for_the_epoch() -> None:
    first, second = MeshBlocks(epoch=1), MeshBlocks()
    for blocks in (first, second):
        blocks.update(sheet(3.0))
        blocks.update(sheet(3.0, dent=(1.5, 1.5)))
    assert encode(first.page()) == encode(second.page().model_copy(update={"epoch": 1}))
    assert second.epoch != MeshBlocks().epoch


def test_a_ground_station_that_started_again_replaces_the_whole_map() -> None:
    cache, old, new = MeshCache(), MeshBlocks(epoch=1), MeshBlocks(epoch=2)
    old.update(sheet(3.0))
    watch(cache, old)
    new.update(sheet(1.0))
    page = new.page(old.revision, old.epoch)
    redraw = cache.take(page)
    assert [block.key for block in redraw.draw] == [(0, 0, 0)]
    assert len(redraw.remove) == 8
    assert cache.parameters == f"since={new.revision};epoch=2"


def test_a_redraw_names_what_is_new_and_what_is_gone() -> None:
    cache, blocks = MeshCache(), MeshBlocks(epoch=3)
    blocks.update(sheet(2.0))
    assert [block.key for block in cache.take(blocks.page()).draw] == [(0, 0, 0), (0, 1, 0), (1, 0, 0), (1, 1, 0)]
    seen = blocks.revision
    blocks.update(sheet(1.0, dent=(0.5, 0.5)))
    redraw = cache.take(blocks.page(seen, 3))
    assert [block.key for block in redraw.draw] == [(0, 0, 0)]
    assert redraw.remove == ((0, 1, 0), (1, 0, 0), (1, 1, 0))


def test_a_page_that_comes_twice_is_drawn_once() -> None:
    cache, blocks = MeshCache(), MeshBlocks()
    blocks.update(sheet(2.0))
    page = blocks.page()
    cache.take(page)
    again = cache.take(page)
    assert (again.draw, again.remove) == ((), ())


VERTICES, FACES, COLOURS = np.zeros((3, 3), np.float32), np.array([[0, 1, 2]], np.int32), np.zeros((3, 3), np.uint8)


@pytest.mark.parametrize(
    ("vertices", "faces", "colours"),
    [
        (VERTICES, np.array([[0, 1, 3]], np.int32), COLOURS),
        (VERTICES, np.array([[0, -1, 2]], np.int32), COLOURS),
        (VERTICES, np.array([0, 1, 2], np.int32), COLOURS),
        (VERTICES, np.array([[0, 1]], np.int32), COLOURS),
        (VERTICES, FACES.astype(np.float32), COLOURS),
        (VERTICES[:, :2], FACES, COLOURS[:, :2]),
        (VERTICES.astype(np.float64), FACES, COLOURS),
        (VERTICES, FACES, COLOURS[:2]),
        (VERTICES, FACES, COLOURS.astype(np.int32)),
        (np.zeros((0, 3), np.float32), FACES, np.zeros((0, 3), np.uint8)),
        (VERTICES, np.zeros((1, 0), np.int32), COLOURS),
    ],
)
def test_a_block_that_is_no_mesh_is_counted_and_not_drawn(
    vertices: np.ndarray, faces: np.ndarray, colours: np.ndarray
) -> None:
    cache = MeshCache()
    good = MeshBlock(key=(0, 0, 0), revision=1, vertices=VERTICES, faces=FACES, colours=COLOURS)
    bad = MeshBlock(key=(0, 0, 1), revision=2, vertices=vertices, faces=faces, colours=colours)
    redraw = cache.take(MeshPage(epoch=9, revision=2, complete=True, blocks=(good, bad)))
    assert [block.key for block in redraw.draw] == [(0, 0, 0)]
    assert cache.refused == 1
