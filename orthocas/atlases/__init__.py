"""Atlases: many charts that cover the joint range of a robot (ours).

- `plan` holds what the boxes of an atlas share: the problem, the joints that boxes divide, and what is asked for.
- `lattice` and `symmetry` cut the range into tiles, of which many are images of others.
- `box_fit` fits and judges the chart of one box; `jobs` makes that a piece of work for any executor.
- `build` runs the jobs, splits boxes that are not good enough, and appends results to the file.
- `atlas_file` is that file; `index` finds the chart of a joint position; `align` gives neighbours one order and sign.
- `atlas` is what users see; `coverage` measures it.
"""

__all__: list[str] = []
