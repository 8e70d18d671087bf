"""Files of every kind that are damaged are read or refused in one line."""

import numpy as np
import pytest

from tasks.benchmarks import damaged_files


@pytest.mark.parametrize("kind", damaged_files.kinds())
def test_a_damaged_file_is_read_or_refused_in_one_line(kind: str) -> None:
    row = damaged_files.read_damaged(kind, 25, seed=1)
    assert row["read"] + row["refused"] == 25 and not row["faults"]


def test_a_file_that_is_read_with_numbers_that_are_not_finite_would_be_seen() -> None:
    assert damaged_files.is_finite((1.0, {"a": [np.ones(3)]}))
    assert not damaged_files.is_finite((1.0, {"a": [np.array([1.0, np.nan])]}))
