"""The table of mutations fits the code; `python -m tests.mutations` shows that each is caught."""

from __future__ import annotations

import pytest

from tests.mutations import ROOT, TABLE, Mutation, mutated, read_table


def test_every_row_of_the_page_is_read() -> None:
    numbers = [mutation.number for mutation in read_table()]
    assert numbers == list(range(1, len(numbers) + 1))
    assert TABLE.read_text().count("\n| ") == len(numbers) + 1, "each row can be read"


@pytest.mark.parametrize("mutation", read_table(), ids=lambda mutation: str(mutation.number))
def test_a_row_fits_the_code(mutation: Mutation) -> None:
    assert mutated(mutation) != (ROOT / mutation.file).read_text()
    assert all((ROOT / test.partition("::")[0]).exists() for test in mutation.tests.split())
