"""``python -m sim_bridge.scenes``: the truth of a scene that was not flown, for ``covrecon evaluate``."""

from __future__ import annotations

import argparse
import logging
import sys
from pathlib import Path

from protocol.errors import CovreconError
from protocol.mission_file import load_mission
from sim_bridge.scenes.cache import scene_cache
from sim_bridge.scenes.scene import load_scene
from sim_bridge.scenes.truth import write_truth


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="python -m sim_bridge.scenes")
    parser.add_argument("scene", help="as in a mission's simulation.scene")
    parser.add_argument("mission", type=Path, help="whose target box, flight region and camera say what can be seen")
    parser.add_argument("out", type=Path, help="folder for truth.ply and truth_samples.npz")
    parsed = parser.parse_args(arguments)
    logging.basicConfig(format="%(message)s", level=logging.INFO)
    try:
        mission = load_mission(parsed.mission, drones=1, replaced={"simulation.scene": parsed.scene})
        cache = scene_cache()
        scene = load_scene(parsed.scene, relative_to=Path(), cache=cache, on_progress=logging.getLogger(__name__).info)
        write_truth(scene, mission, parsed.out, cache=cache)
    except CovreconError as error:
        sys.stderr.write(f"{error}\n")
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
