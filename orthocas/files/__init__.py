"""Files that orthocas writes and reads. Writing is atomic, and loading never runs code.

- `archive` is the container: a zip of a JSON header, `.npy` arrays and checksums. Checkpoints use it too.
- `chart_file` maps a chart to the header and arrays of an archive, and back.
- `atomic` writes files that appear whole or not at all, and checks early whether a path is writable.
- `json` turns results into plain data for JSON.
"""

__all__: list[str] = []
