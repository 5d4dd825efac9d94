"""A value that is worked out when it is first asked for."""

import pickle
from copy import deepcopy

import pytest

from phsi_opt.later import Later


def test_the_work_is_done_once_and_begins_anew_where_it_was_interrupted() -> None:
    calls: list[int] = []

    def work() -> int:
        calls.append(1)
        if len(calls) == 1:
            raise KeyboardInterrupt
        return 7

    later = Later(work)
    assert calls == []
    with pytest.raises(KeyboardInterrupt):
        _ = later.value
    assert (later.value, later.value) == (7, 7)
    assert calls == [1, 1]


def test_copies_hold_the_value() -> None:
    later = Later(lambda: [1, 2])  # a lambda cannot be pickled
    assert pickle.loads(pickle.dumps(later)).value == [1, 2]
    assert deepcopy(later).value == [1, 2]
