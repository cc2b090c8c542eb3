"""Charts: a task x = h(q) and extra coordinates xi(q) of a redundant arm, which together replace its joint positions.

    phi(q) = [h(q); xi(q)],  det dphi/dq != 0 on a domain

`chart.Chart` holds both, and saves itself. `inverse` finds q for phi, by searches in `newton`, `curves`, `descent` and
`inside`; `trackers` follow streams of phi. `self_motion` says how far xi reaches, and `walls` what stops it; `quality`
and `point_quality` say how good a chart is, and `certificate` what is proved of it. `grow` makes charts along flows;
`orthocas.fitting` fits them.

This module itself gives ready charts of known arms, fitted and certified. `names` lists them, `load` gives a chart, and
`card` describes how good it is, where it holds, and how it was made; docs/how-to/ready_charts.md shows all.
"""

from orthocas.charts.ready import Card, Model, card, load, names

__all__ = ["Card", "Model", "card", "load", "names"]
