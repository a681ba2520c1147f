"""What training on a processor sets up."""

import os
import threading

import pytest
import torch

from lerobot_unimask.machine import wait_without_spinning


@pytest.mark.parametrize(
    ("load", "threads", "told", "done"),
    [(3.0, 2, {}, True), (0.2, 2, {}, False), (3.0, 1, {}, False), (3.0, 2, {"OMP_WAIT_POLICY": "active"}, False)],
)
def test_threads_sleep_while_they_wait_where_the_cores_are_shared(load, threads, told, done, monkeypatch):
    monkeypatch.setattr(os, "getloadavg", lambda: (load, load, load))
    monkeypatch.setattr(torch, "get_num_threads", lambda: threads)
    monkeypatch.setattr(os, "environ", told)
    before = threading.active_count()
    assert wait_without_spinning.__wrapped__() is done
    assert threading.active_count() == before + done
