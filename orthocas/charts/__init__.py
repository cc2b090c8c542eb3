"""Charts: a task x = h(q) and extra coordinates xi(q) of a redundant arm, which together replace its joint positions.

    phi(q) = [h(q); xi(q)],  det dphi/dq != 0 on a domain

`chart.Chart` holds both, and is stored in files by `chart_file`. `inverse` computes q from phi, with the searches of
`newton`, `curves`, `descent` and `inside`; `trackers` follow streams of phi. `self_motion` computes the range of xi,
and `walls` what limits it. `quality` and `point_quality` measure a chart, and `certificate` records what is proved of
it. `grow` makes exact charts along flows; `orthocas.fitting` fits charts.

The names of this package itself are for ready charts of known arms: `names` lists them, `load` loads one, and `card`
describes its quality, its domain, and how it was made. See docs/how-to/ready_charts.md.
"""

from orthocas.charts.ready import Card, Model, card, load, names

__all__ = ["Card", "Model", "card", "load", "names"]
