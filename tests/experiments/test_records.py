import pytest

from udrl_experiments.records import agent_name


@pytest.mark.parametrize(
    ("algorithm", "variant", "name"),
    [("UDRL", "", "UDRL"), ("UDRL", "paper", "UDRL-paper"), ("UDRL", "lead 2", "UDRL lead 2")],
)
def test_names_of_agents(algorithm: str, variant: str, name: str) -> None:
    assert agent_name(algorithm, variant) == name
