"""The rows of `mutations.md` fit the code; `python -m tests.mutations` runs them."""

from __future__ import annotations

import pytest

from tests.mutations import ROOT, TABLE, Mutation, mutated, read_table


def test_every_row_of_the_table_can_be_read() -> None:
    numbers = [mutation.number for mutation in read_table()]
    assert numbers == list(range(1, len(numbers) + 1))
    assert TABLE.read_text().count("\n| ") == len(numbers) + 1, "a row has an invalid format"


@pytest.mark.parametrize("mutation", read_table(), ids=lambda mutation: str(mutation.number))
def test_the_text_of_a_row_occurs_once_in_its_file(mutation: Mutation) -> None:
    assert mutated(mutation) != (ROOT / mutation.file).read_text()
    assert all((ROOT / test.partition("::")[0]).exists() for test in mutation.tests.split())
