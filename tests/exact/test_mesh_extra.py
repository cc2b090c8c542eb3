"""Without libigl, charts on surfaces name the extra that has it."""

import sys

import numpy as np
import pytest

from orthocas.errors import MissingExtraError
from orthocas.exact.mesh import TriangleMesh


def test_meshes_without_libigl_name_the_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "igl", None)
    mesh = TriangleMesh(np.eye(3), np.array([[0, 1, 2]]))
    with pytest.raises(MissingExtraError, match=r"pip install 'orthocas\[mesh\]'"):
        mesh.edges  # noqa: B018
