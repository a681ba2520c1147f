"""What a Hub may answer but for what was asked, and what may not leave this machine.

Run by `test_hub.py` after `hub_flow.py` and in its process, with the dataset and the policy that it has made.
"""

import shutil

import pytest
from hub_flow import HOME, HUB, command, head
from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata

from lerobot_unimask import UniMASKPolicy
from lerobot_unimask.sharing.hub import HubError

ROOT = HOME / "data" / "doorkey"
CHECKPOINT = HOME / "runs" / "first" / "checkpoints" / "last" / "pretrained_model"


def push(capsys, *arguments: str) -> str:
    """The one error that `unimask push` ends with."""
    capsys.readouterr()
    with pytest.raises(SystemExit):
        command("unimask", "push", *arguments)
    return capsys.readouterr().err


def test_a_dataset_refused_at_its_tag_says_what_is_there(capsys):
    flags = [f"--dataset.root={ROOT}", "--repo_id=me/untagged"]
    with HUB.fault(r"POST .*/tag/", status=403):
        said = push(capsys, *flags)
    there = HUB.dataset("me/untagged")
    assert f" {len(there.files) - 1} files" in said
    assert head("me/untagged", "dataset")[:8] in said
    assert "not the tag v3.0" in said
    command("unimask", "push", *flags)
    assert there.tags == {"v3.0": head("me/untagged", "dataset")}


@pytest.mark.parametrize(("flag", "source"), [("--dataset.root", ROOT), ("--policy.path", CHECKPOINT)])
def test_a_link_out_of_the_folder_is_not_pushed(flag, source, tmp_path, capsys):
    folder = tmp_path / "folder"
    shutil.copytree(source, folder)
    (tmp_path / "secret.json").write_text("{}")
    (folder / "notes.json").symlink_to(tmp_path / "secret.json")
    assert f"{folder / 'notes.json'} is a link out of its folder" in push(
        capsys, f"{flag}={folder}", "--repo_id=me/link"
    )
    assert not any(name == "me/link" for _, name in HUB.repositories)


@pytest.mark.parametrize("status", [404, 429, 500, 503])
def test_what_the_hub_answers_a_push_is_said(status, capsys, monkeypatch):
    monkeypatch.setattr("huggingface_hub.utils._http.time.sleep", lambda _: None)  # the client tries again by itself
    with HUB.fault(r"POST /api/repos/create", status=status):
        said = push(capsys, f"--policy.path={CHECKPOINT}", f"--repo_id=me/status_{status}")
    assert f"status {status}" in said
    assert "nothing of this push is to be seen there" in said


def test_a_login_page_in_place_of_the_hub_is_named_when_pushing(capsys):
    with HUB.fault(r"GET /api/models/", page=True):
        assert "is not a Hub" in push(capsys, f"--policy.path={CHECKPOINT}", "--repo_id=me/portal")


@pytest.mark.parametrize("status", [403, 404, 429, 500, 503])
@pytest.mark.parametrize("kind", ["policy", "dataset"])
def test_what_the_hub_answers_a_pull_is_said(kind, status, monkeypatch):
    monkeypatch.setattr("huggingface_hub.utils._http.time.sleep", lambda _: None)  # the client tries again by itself
    with HUB.fault(r"(GET|HEAD) /api/", status=status), pytest.raises(HubError, match=rf"status {status}") as error:
        pull(kind)
    assert f"me/unknown_{kind}" in str(error.value)
    assert "cannot be reached" not in str(error.value)


@pytest.mark.parametrize("kind", ["policy", "dataset"])
def test_a_login_page_in_place_of_the_hub_is_named(kind):
    with HUB.fault(r"(GET|HEAD) ", page=True), pytest.raises(HubError, match="is not a Hub"):
        pull(kind)


def pull(kind: str) -> None:
    if kind == "policy":
        UniMASKPolicy.from_pretrained("me/unknown_policy")
    else:
        LeRobotDatasetMetadata("me/unknown_dataset")
