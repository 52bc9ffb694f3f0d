"""What the tests of reports share: a small campaign with many outcomes, simulated once."""

import pytest
from reported import mixed

from aftbed.campaign.ledger import Ledger


@pytest.fixture(scope="session")
def ledger(tmp_path_factory: pytest.TempPathFactory) -> Ledger:
    return mixed(tmp_path_factory.mktemp("mixed"))
