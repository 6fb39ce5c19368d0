"""Two thousand damaged and hostile inputs against the promises of every command; `make fuzz` tries more."""

import pytest

pytest.importorskip("rasterio")
pytest.importorskip("pyogrio")
from fuzz import fuzz


@pytest.mark.parametrize("part", range(4))
def test_no_promise_is_broken(part: int) -> None:
    assert list(fuzz(range(500 * part, 500 * (part + 1)))) == []
