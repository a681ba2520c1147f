"""The gallery's page names its pictures, and these are small."""

import pytest
import torch
from matplotlib.figure import Figure
from PIL import Image
from policies import CORNER, MAZE, MAZE_STATS, few_draws

from lerobot_unimask import cli
from lerobot_unimask.paper import gallery
from lerobot_unimask.paper.gallery import LARGEST, Picture, doorkey_pictures, maze_pictures, write_gallery


def test_the_page_names_every_picture(tmp_path):
    pictures = [Picture(name, name.title(), f"about {name}", Figure()) for name in ("one", "two")]
    page, *files = write_gallery(iter(pictures), tmp_path, command="unimask gallery")
    text = page.read_text()
    assert [file.name for file in files] == ["one.png", "two.png"]
    for name in ("one", "two"):
        assert f"## {name.title()}\n\nabout {name}\n\n![{name.title()}](gallery/{name}.png)" in text
        assert Image.open(tmp_path / "gallery" / f"{name}.png").width > 100


def test_every_picture_of_a_doorkey_policy_is_small(tiny_policy, doorkey, doorkey_batch, tmp_path, monkeypatch):
    """Of a model that has learnt nothing; its samples would not pass a real check."""
    accept = lambda **_: lambda values, decided: torch.ones(len(values["s"]), dtype=torch.bool)  # noqa: E731
    monkeypatch.setattr(gallery, "DynamicsCheck", accept)
    monkeypatch.setattr(gallery, "START_PAIRS", gallery.START_PAIRS[::8])
    features = {**doorkey.meta.features, "observation.visits_corner": CORNER}
    policy = tiny_policy(features=features, properties=["observation.visits_corner"])
    with few_draws():
        _, *files = write_gallery(doorkey_pictures(policy, doorkey_batch), tmp_path, command="unimask gallery")
    names = ["mask", "marginals", "state_distributions", "five_panels", "backwards", "distributions", "property"]
    assert [file.stem for file in files] == names
    assert all(file.stat().st_size < LARGEST for file in files)


def test_a_maze_policy_has_its_pictures(tiny_policy):
    policy = tiny_policy("gaussian", features=MAZE, stats=MAZE_STATS)
    states = torch.tensor([[1.0 + 0.1 * step, 1.0, 3.0, 2.0] for step in range(10)]).repeat(3, 1, 1)
    batch = {"observation.state": states, "action": torch.zeros(3, 10, 2)}
    picture, starts = maze_pictures(policy, batch, states[:, 0])
    assert (picture.name, starts.name) == ("maze2d", "maze2d_starts")
    assert sum(line.get_marker() == "*" for line in starts.figure.axes[0].lines) == len(states)
    assert "s[:] | s[0], s[5]" in picture.text


def test_a_maze_policy_needs_its_data(capsys):
    with pytest.raises(SystemExit):
        cli.main(["paper", "gallery", "--policy.path=p", "--dataset.root=d", "--maze.path=m"])
    assert "--maze.path and --maze.root go together" in capsys.readouterr().err
