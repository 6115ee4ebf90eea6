"""The planted faults of `mutation_check.py` still fit the code. Running them takes minutes."""

import mutation_check
import pytest


@pytest.mark.parametrize(
    "fault", mutation_check.FAULTS, ids=lambda fault: f"{fault.module}: {fault.description}"
)
def test_a_fault_has_one_place(fault):
    assert mutation_check._module(mutation_check.ROOT, fault).read_text().count(fault.old) == 1
