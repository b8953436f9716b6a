"""Ratios of one run: scalar solver, batch and the papers' grid (its time extrapolated from a part of its rows).

Run it with ``python benchmarks/cone_benchmark.py``; it asserts nothing.
"""

from __future__ import annotations

from analysis.accuracy.cone_study import PROBLEMS, sweep_scenes
from analysis.accuracy.timing import timed
from model import cone, grid
from model.batch import solve_many

ROWS = 401


def main() -> None:
    positions, radii = grid.PAPER_GRID
    for name, scene in PROBLEMS.items():
        _, ours = timed(lambda scene=scene: cone.solve(scene), 301)
        print(f"{name}: {ours.median * 1e3:.3f} ms (first call {ours.first * 1e3:.1f} ms)")
        for described in (True, False):
            call = lambda scene=scene, described=described: grid.solve(  # noqa: E731
                scene, positions=ROWS, radii=radii, as_described=described
            )
            whole = timed(call, 1)[1].median * positions / ROWS
            kind = "as described" if described else "improved"
            print(f"  {positions} x {radii} grid, {kind}: {whole:.1f} s, {whole / ours.median:,.0f} times slower")
    scenes = sweep_scenes(16384)
    _, batch = timed(lambda: solve_many(scenes), 3)
    print(f"batch: {len(scenes) / batch.median:,.0f} scenes per second")


if __name__ == "__main__":
    main()
