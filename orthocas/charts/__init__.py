"""Ready charts of known arms, fitted and certified, each with a card of its quality.

`names` lists them, `load` gives a chart, and `card` describes how good it is, where it holds, and how it was made.
`make charts` makes them again; docs/how-to/ready_charts.md shows all.
"""

from orthocas.charts.ready import Card, Model, card, load, names

__all__ = ["Card", "Model", "card", "load", "names"]
