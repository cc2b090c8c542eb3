"""The campaign of faults: `make fuzz` mutates all that comes from outside, and looks at what orthocas makes of it.

The rule is the same everywhere: a valid result, or one OrthocasError of one line; nothing else, within time and memory.
"""
