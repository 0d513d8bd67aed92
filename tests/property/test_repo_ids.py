"""Names of datasets, verified by the library with which LeRobot loads them."""

from __future__ import annotations

import contextlib

from huggingface_hub.errors import HFValidationError
from huggingface_hub.utils._validators import validate_repo_id
from hypothesis import given
from hypothesis import strategies as st

from demorec.core.errors import ConfigError
from demorec.datasets.lerobot.options import check_repo_id

words = st.text(st.sampled_from("aZ09_-.é "), min_size=0, max_size=6)


@given(st.one_of(st.builds("{}/{}".format, words, words), words, st.builds("{}/{}/{}".format, words, words, words)))
def test_accepted_names_are_those_of_the_hub(name: str) -> None:
    hub = True
    with contextlib.suppress(HFValidationError):
        validate_repo_id(name)
        hub = False
    refused = hub or name.count("/") != 1  # LeRobot splits a name at the slash
    try:
        check_repo_id(name)
    except ConfigError:
        # Stricter than the Hub in one point: letters must be ASCII, as the Hub's servers require.
        assert refused or not name.isascii()
    else:
        assert not refused
