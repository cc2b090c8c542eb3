"""Arrays in files: what NumPy writes is read, and nothing that fails later."""

import numpy as np
import pytest

from orthocas.tools.archive import read_npy, write_npy


@pytest.mark.parametrize("order", ["<", ">"])
def test_texts_of_both_byte_orders_are_read(order: str) -> None:
    texts = np.array(["abc", "d\N{GRINNING FACE}", ""]).astype(f"{order}U3")
    np.testing.assert_array_equal(read_npy(write_npy(texts)), texts)


@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize("code", [0x110000, 0xFFFFFFFF, 0xD800, 0xDFFF])
def test_texts_with_invalid_characters_are_refused(code: int, order: str) -> None:
    """NumPy reads them, and Python fails with a SystemError when they are used."""
    content = write_npy(np.frombuffer(np.array([65, code], dtype=f"{order}u4").tobytes(), f"{order}U2"))
    with pytest.raises(ValueError, match="text with invalid characters"):
        read_npy(content)


def test_texts_next_to_the_surrogates_are_read() -> None:
    texts = np.array(["\ud7ff", "\ue000", "\U0010ffff"])
    np.testing.assert_array_equal(read_npy(write_npy(texts)), texts)
