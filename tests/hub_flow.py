"""Policies and datasets by way of a Hub on the loopback, with the real client and the real commands.

huggingface_hub reads HF_ENDPOINT when it is imported, so `test_hub.py` runs this file in a process of its own. The
tests build on each other, from top to bottom. To run them alone: `pytest --noconftest tests/hub_flow.py`.
"""

import atexit
import contextlib
import json
import os
import shutil
import socket
import sys
import tempfile
import threading
from pathlib import Path

import pytest
from hub_server import File, Hub

HUB = Hub({"token-of-me": "me", "token-of-you": "you"}).__enter__()
HOME = Path(tempfile.mkdtemp(prefix="hub_flow_"))
atexit.register(shutil.rmtree, HOME, ignore_errors=True)
os.environ.update(
    HF_ENDPOINT=HUB.endpoint, HF_HOME=str(HOME), HF_TOKEN="token-of-me", HF_HUB_DISABLE_XET="1", HF_HUB_OFFLINE="0"
)
os.environ.pop("HF_LEROBOT_HOME", None)

ELSEWHERE: list[object] = []  # what has been tried to reach but for the loopback


def _refuse_elsewhere(connect):
    def guarded(self, address):
        if self.family != socket.AF_UNIX and address[0] not in ("127.0.0.1", "::1", "localhost"):
            ELSEWHERE.append(address)
            raise ConnectionRefusedError(f"{address} is not on the loopback")
        return connect(self, address)

    return guarded


socket.socket.connect = _refuse_elsewhere(socket.socket.connect)
socket.socket.connect_ex = _refuse_elsewhere(socket.socket.connect_ex)

import torch  # noqa: E402
import yaml  # noqa: E402
from huggingface_hub import constants  # noqa: E402
from lerobot.scripts import lerobot_eval, lerobot_train  # noqa: E402

import lerobot_policy_unimask  # noqa: E402, F401
from lerobot_unimask import UniMASKPolicy, cli  # noqa: E402
from lerobot_unimask.sharing import cards, hub  # noqa: E402
from lerobot_unimask.sharing.hub import HubError  # noqa: E402

torch.set_num_threads(1)

SMALL = ["--policy.width=16", "--policy.depth=1", "--policy.heads=2", "--policy.feedforward_width=16"]
SMALL += ["--policy.context_length=10"]
TRAIN = ["--batch_size=8", "--num_workers=0", "--policy.device=cpu"]
FILES = {  # of a pushed policy
    ".gitattributes",
    "README.md",
    "mask.png",
    "config.json",
    "model.safetensors",
    "train_config.json",
    "policy_preprocessor.json",
    "policy_postprocessor.json",
}
CACHE = HOME / "hub"


def command(script: str, *arguments: str) -> None:
    """A console script, in this process."""
    before, sys.argv = sys.argv, [script, *arguments]
    try:
        {"lerobot-train": lerobot_train.main, "lerobot-eval": lerobot_eval.main, "unimask": cli.main}[script]()
    finally:
        sys.argv = before


@pytest.fixture
def unimask(capsys):
    """unimask("push", ...) -> what it printed."""

    def run(*arguments: object) -> str:
        capsys.readouterr()
        cli.main([str(argument) for argument in arguments])
        return capsys.readouterr().out

    return run


@pytest.fixture
def refused(capsys):
    """refused("push", ...) -> the one error that it ends with."""

    def run(*arguments: object) -> str:
        capsys.readouterr()
        with pytest.raises(SystemExit) as ended:
            cli.main([str(argument) for argument in arguments])
        assert ended.value.code == 2
        said = capsys.readouterr().err
        assert said.count("unimask: error:") == 1
        return said

    return run


def head(repo_id: str, kind: str = "model") -> str:
    return HUB.repositories[kind, repo_id].branches["main"]


def blobs(repo_id: str) -> list[str]:
    """What the local cache keeps of a model."""
    return sorted(path.name for path in (CACHE / f"models--{repo_id.replace('/', '--')}").rglob("*") if path.is_file())


@pytest.fixture(scope="module")
def root():
    """A dataset, built and pushed as a user does."""
    root = HOME / "data" / "doorkey"
    flags = ["--episodes=40", f"--root={root}", "--repo_id=me/doorkey", "--push_to_hub=true"]
    command("unimask", "build", "doorkey", *flags)
    return root


@pytest.fixture(scope="module")
def run(root):
    """A training that pulls the dataset by its name alone, and pushes its checkpoints and, at the end, the policy."""
    run = HOME / "runs" / "first"
    command(
        "lerobot-train",
        "--policy.type=unimask",
        *SMALL,
        *TRAIN,
        "--policy.repo_id=me/policy",
        '--policy.training_masks=["random_mask", "goal_conditioned"]',
        "--policy.inference_mask=reward_conditioned",
        "--policy.target_return=auto",
        "--dataset.repo_id=me/doorkey",
        "--env.type=doorkey",
        "--env_eval_freq=0",
        "--steps=4",
        "--save_freq=2",
        "--save_checkpoint_to_hub=true",
        f"--output_dir={run}",
    )
    return run


@pytest.fixture(scope="module")
def checkpoint(run):
    return run / "checkpoints" / "last" / "pretrained_model"


# --- From one end to the other ---------------------------------------------------------------------------------------


def test_a_dataset_is_pushed_whole_with_its_card_and_tag(root):
    repository = HUB.dataset("me/doorkey")
    assert repository.messages == ["initial commit", "Upload dataset and card"]
    assert repository.tags == {"v3.0": head("me/doorkey", "dataset")}
    there = {str(path.relative_to(root)): path.read_bytes() for path in root.rglob("*") if path.is_file()}
    added = {path: data for path, data in repository.files.items() if path not in there}
    assert {path: repository.files[path] for path in there} == there
    assert set(added) == {".gitattributes", "README.md", "episodes.png"}
    large = {path for path, file in repository.commits[head("me/doorkey", "dataset")].items() if file.large}
    assert large == {path for path in repository.files if path.endswith((".parquet", ".png"))}


def test_a_training_pushes_the_policy_in_one_commit_and_its_checkpoints(run, checkpoint):
    repository = HUB.model("me/policy")
    upload = "Upload policy: weights, config, processors, train config and card"
    assert repository.messages[:4] == ["initial commit", "checkpoint 000002", "checkpoint 000004", upload]
    assert set(repository.tags) == {"000002", "000004"}
    first = list(repository.commits.values())[3]
    own = {path for path in first if not path.startswith("checkpoints/")}
    assert own >= FILES
    assert first["model.safetensors"].data == (checkpoint / "model.safetensors").read_bytes()
    assert first["model.safetensors"].large
    assert not first["config.json"].large
    assert not [path for path in repository.files if path.endswith((".pkl", ".pickle", ".pt", ".pth", ".bin", ".npy"))]
    saved = "checkpoints/000002/pretrained_model/model.safetensors"
    assert repository.files[saved] == (run / saved).read_bytes()


def test_the_cards_say_what_there_is(checkpoint):
    card = HUB.model("me/policy").files["README.md"].decode()
    assert yaml.safe_load(card.split("---\n")[1])["datasets"] == ["me/doorkey"]
    assert head("me/doorkey", "dataset") in card
    assert "lerobot-train --policy.type=unimask" in card
    assert "40, 400 steps" in HUB.dataset("me/doorkey").files["README.md"].decode()


def answers(policy: UniMASKPolicy) -> list[torch.Tensor]:
    """Some of everything: marginals, samples, and actions for automatic target returns."""
    given = {"s[0]": [5, 0], "s[-1]": [15, 15]}
    marginals = policy.infer(None, "s[1:9] | s[0], s[-1]", given=given)["s"]
    drawn = policy.sample(None, "s[1:9], a[:] | s[0], s[-1]", given=given, samples=3, seed=1).values
    policy.reset()
    states = torch.tensor([[0.0, 5.0], [5.0, 0.0], [1.0, 8.0]])
    acted = policy.select_action({"observation.state": states, "observation.return_so_far": torch.zeros(3, 1)})
    wanted = policy.episode_starts.nearest_return(states)
    return [*(part.probabilities for part in marginals), *drawn.values(), acted, wanted]


def test_a_pulled_policy_gives_the_same_answers_bit_for_bit(checkpoint):
    saved, pulled = UniMASKPolicy.from_pretrained(checkpoint), UniMASKPolicy.from_pretrained("me/policy")
    assert pulled.origin == ("me/policy", head("me/policy"))
    assert saved.origin == (str(checkpoint), None)
    for ours, theirs in zip(answers(saved), answers(pulled), strict=True):
        assert torch.equal(ours.nan_to_num(), theirs.nan_to_num())
    assert pulled.config.dataset_revision == head("me/doorkey", "dataset")


def test_lerobot_eval_takes_the_repository_s_name(run):
    command(
        "lerobot-eval",
        "--policy.path=me/policy",
        "--env.type=doorkey",
        "--eval.n_episodes=2",
        "--eval.batch_size=2",
        f"--output_dir={HOME / 'eval'}",
    )
    assert json.loads((HOME / "eval" / "eval_info.json").read_text())["overall"]["n_episodes"] == 2


def test_query_answers_and_says_how_to_ask_again(checkpoint, unimask):
    question = ["--dataset.repo_id=me/doorkey", "--episode=1", "--mask=forward_dynamics", "--t=3", "--json"]
    answer = json.loads(unimask("query", "--policy.path=me/policy", *question))
    assert answer["policy"]["path"] == "me/policy"
    assert answer["policy"]["revision"] == head("me/policy")
    assert answer["mask"] == "forward_dynamics"
    again = json.loads(
        unimask("query", "--policy.path=me/policy", f"--policy.revision={answer['policy']['revision']}", *question)
    )
    assert again == answer
    assert json.loads(unimask("query", f"--policy.path={checkpoint}", *question))["answers"] == answer["answers"]


def test_fine_tuning_goes_on_from_the_repository(run):
    tuned = HOME / "runs" / "tuned"
    flags = [
        "--policy.path=me/policy",
        "--policy.push_to_hub=false",
        "--policy.training_masks=behavior_cloning",
        *TRAIN,
    ]
    command("lerobot-train", *flags, "--dataset.repo_id=me/doorkey", "--steps=1", f"--output_dir={tuned}")
    policy = UniMASKPolicy.from_pretrained(tuned / "checkpoints" / "last" / "pretrained_model")
    assert int(policy.updates) == 4 + 1
    assert policy.config.training_masks == "behavior_cloning"


def test_a_training_resumes_from_the_repository(run):
    resumed = HOME / "runs" / "resumed"
    flags = ["--config_path=me/policy", "--resume=true", "--policy.push_to_hub=false", "--save_checkpoint_to_hub=false"]
    command("lerobot-train", *flags, "--steps=5", f"--output_dir={resumed}")
    assert int(UniMASKPolicy.from_pretrained(resumed / "checkpoints" / "000005" / "pretrained_model").updates) == 5


def test_the_train_config_trains_again(checkpoint, unimask):
    """The command on the card of a checkpoint that somebody else's process has trained."""
    unimask("push", f"--policy.path={checkpoint}", "--repo_id=me/again")
    card = HUB.model("me/again").files["README.md"].decode()
    (line,) = [line for line in card.splitlines() if line.startswith("lerobot-train --config_path=")]
    flags = line.replace("outputs/again", str(HOME / "runs" / "again")).split()[1:]
    command("lerobot-train", *flags, "--save_checkpoint_to_hub=false", "--steps=1")
    assert int(UniMASKPolicy.from_pretrained(HOME / "runs/again/checkpoints/last/pretrained_model").updates) == 1


def test_an_earlier_checkpoint_is_a_revision_away(run):
    with pytest.raises(
        HubError, match=r"config\.json.*'000002'"
    ):  # the commit of a checkpoint has no policy at its top
        UniMASKPolicy.from_pretrained("me/policy", revision="000002")
    policy = UniMASKPolicy.from_pretrained("me/policy", revision=head("me/policy"))
    assert int(policy.updates) == 4


# --- unimask push -----------------------------------------------------------------------------------------------------


def test_push_takes_a_run_and_changes_nothing_the_second_time(run, checkpoint, unimask):
    results = HOME / "eval" / "eval_info.json"
    push = ["push", f"--policy.path={run}", "--repo_id=me/copy", "--private", f"--results={results}"]
    assert f"{HUB.endpoint}/me/copy" in unimask(*push)
    repository = HUB.model("me/copy")
    assert repository.private
    assert set(repository.files) >= FILES
    assert "Rollouts: 2 episodes" in repository.files["README.md"].decode()
    assert repository.files["model.safetensors"] == (checkpoint / "model.safetensors").read_bytes()
    first = head("me/copy")
    unimask(*push)
    assert head("me/copy") == first


def test_a_policy_saved_in_python_is_whole_too(checkpoint, unimask):
    folder = HOME / "saved"
    UniMASKPolicy.from_pretrained(checkpoint).save_pretrained(folder)
    unimask("push", f"--policy.path={folder}", "--repo_id=me/saved")
    assert set(HUB.model("me/saved").files) >= FILES - {"train_config.json"}
    flags = ["--env.type=doorkey", "--eval.n_episodes=1", "--eval.batch_size=1", f"--output_dir={HOME / 'eval_saved'}"]
    command("lerobot-eval", "--policy.path=me/saved", *flags)


# --- What goes wrong with pushing ------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("token", "repo_id", "words"),
    [
        (None, "me/none", "wants a token: log in with `hf auth login` or set HF_TOKEN"),
        ("token-of-nobody", "me/none", "refuses your token"),
        ("token-of-you", "me/none", "your token may not write there"),
        ("token-of-me", "me none", "names are ME/NAME"),
    ],
)
def test_a_push_without_the_right_token_ends_in_one_error(checkpoint, refused, monkeypatch, token, repo_id, words):
    monkeypatch.delenv("HF_TOKEN")
    if token:
        monkeypatch.setenv("HF_TOKEN", token)
    assert words in refused("push", f"--policy.path={checkpoint}", f"--repo_id={repo_id}")
    assert ("model", repo_id) not in HUB.repositories


@pytest.mark.parametrize(
    ("name", "pattern", "status"),
    [
        ("upload", r"PUT /storage/", 507),  # after the first file: the one of the policy's large files that comes last
        ("verify", r"POST /verify/", 400),
        ("commit", r"POST .*/commit/", 500),
        ("preupload", r"POST .*/preupload/", 400),
    ],
)
def test_a_server_error_in_the_middle_of_a_push_leaves_nothing_to_be_seen(
    checkpoint, refused, unimask, name, pattern, status
):
    repo_id = f"me/broken_{name}"
    push = ["push", f"--policy.path={checkpoint}", f"--repo_id={repo_id}"]
    with contextlib.ExitStack() as faults:
        if name == "upload":
            faults.enter_context(HUB.fault(pattern, times=1, wait=lambda: None))  # let one file pass
        faults.enter_context(HUB.fault(pattern, status=status))
        said = refused(*push)
    assert repo_id in said
    assert f"unimask push --policy.path={checkpoint} --repo_id={repo_id}" in said
    assert set(HUB.model(repo_id).files) == {".gitattributes"}
    if name == "upload":
        assert HUB.model(repo_id).large  # what has arrived is not wasted
    with pytest.raises(HubError, match=repo_id):
        UniMASKPolicy.from_pretrained(repo_id)
    unimask(*push)
    assert int(UniMASKPolicy.from_pretrained(repo_id).updates) == 4


def test_a_passing_server_error_is_not_even_noticed(checkpoint, unimask):
    with HUB.fault(r"PUT /storage/", times=1, status=500):
        unimask("push", f"--policy.path={checkpoint}", "--repo_id=me/passing")
    assert set(HUB.model("me/passing").files) >= FILES


def test_a_finished_training_that_could_not_push_says_how_to(run, refused):
    again = HOME / "runs" / "unpushed"
    flags = ["--policy.path=me/policy", "--policy.repo_id=me/unpushed", *TRAIN, "--dataset.repo_id=me/doorkey"]
    with HUB.fault(r"POST .*/commit/", status=500), pytest.raises(HubError) as error:
        command("lerobot-train", *flags, "--steps=1", f"--output_dir={again}")
    advice = str(error.value).splitlines()[-1].split()
    assert advice == ["unimask", "push", f"--policy.path={again}", "--repo_id=me/unpushed"]
    cli.main(advice[1:])
    assert int(UniMASKPolicy.from_pretrained("me/unpushed").updates) == 5


def test_of_two_pushes_at_once_one_is_there_and_the_other_is_told(checkpoint):
    cli.main(["push", f"--policy.path={checkpoint}", "--repo_id=me/both"])
    policies = []
    for number in range(2):
        policy = UniMASKPolicy.from_pretrained(checkpoint)
        policy.config.mask_seed = 100 + number
        policy.updates.fill_(100 + number)
        policy.save_pretrained(HOME / f"both_{number}")
        policies.append((policy, HOME / f"both_{number}"))

    barrier, ended = threading.Barrier(2), [None, None]

    def push(number: int) -> None:
        policy, folder = policies[number]
        try:
            hub.push_policy(folder, "me/both", cards.policy_card(policy.card_facts(folder), "me/both"))
        except HubError as error:
            ended[number] = error

    with HUB.fault(r"POST .*/commit/", times=2, wait=lambda: barrier.wait(20)):
        threads = [threading.Thread(target=push, args=(number,)) for number in range(2)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
    (lost,) = [number for number in range(2) if ended[number] is not None]
    assert "me/both" in str(ended[lost])
    for winner in (1 - lost, lost):
        pulled = UniMASKPolicy.from_pretrained("me/both")
        assert (pulled.config.mask_seed, int(pulled.updates)) == (100 + winner, 100 + winner)
        policy, folder = policies[lost]
        hub.push_policy(folder, "me/both", cards.policy_card(policy.card_facts(folder), "me/both"))  # again


def test_a_dataset_that_could_not_be_pushed_is_pushed_later(refused, unimask):
    root = HOME / "data" / "second"
    flags = ["--episodes=3", "--seed=7", f"--root={root}", "--repo_id=me/second", "--push_to_hub=true"]
    with HUB.fault(r"POST .*/commit/", status=500):
        said = refused("build", "doorkey", *flags)
    advice = said.strip().splitlines()[-1].split()
    assert advice == ["unimask", "push", f"--dataset.root={root}", "--repo_id=me/second"]
    assert set(HUB.dataset("me/second").files) == {".gitattributes"}
    with HUB.fault(r"POST .*/tag/", status=500):
        refused(*advice[1:])
    commit = head("me/second", "dataset")
    unimask(*advice[1:])
    assert HUB.dataset("me/second").tags == {"v3.0": commit}
    (root / "meta" / "provenance.json").unlink()
    unimask(*advice[1:])
    assert HUB.dataset("me/second").tags == {"v3.0": head("me/second", "dataset")}  # moved to the new commit
    assert "meta/provenance.json" not in HUB.dataset("me/second").files


def test_a_push_without_a_name_ends_before_the_work(refused):
    root = HOME / "data" / "never"
    assert "--repo_id=ME/NAME" in refused("build", "doorkey", f"--root={root}", "--push_to_hub=true")
    assert not root.exists()


# --- What goes wrong with pulling ------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("path", "revision", "words"),
    [
        ("me/nothing", None, "has no policy me/nothing that you may read"),
        ("outputs/no/folder", None, "neither a folder on this machine nor the name of a repository"),
        ("me/policy", "v9", "me/policy has no revision 'v9'"),
    ],
)
def test_what_is_not_there_ends_in_one_sentence(run, path, revision, words):
    with pytest.raises(HubError, match=r"^[^\n]*$") as error:
        UniMASKPolicy.from_pretrained(path, revision=revision)
    assert words in str(error.value)


def test_a_private_policy_is_its_owner_s_alone(run, monkeypatch):
    for token in ("token-of-you", None):
        monkeypatch.delenv("HF_TOKEN")
        if token:
            monkeypatch.setenv("HF_TOKEN", token)
        with pytest.raises(HubError, match="me/copy"):
            UniMASKPolicy.from_pretrained("me/copy", cache_dir=HOME / "fresh")
        monkeypatch.setenv("HF_TOKEN", "token-of-me")
    assert int(UniMASKPolicy.from_pretrained("me/copy", cache_dir=HOME / "fresh").updates) == 4


def test_a_wrong_token_is_named_when_pulling(run, monkeypatch):
    monkeypatch.setenv("HF_TOKEN", "token-of-nobody")
    with pytest.raises(HubError, match="refuses your token"):
        UniMASKPolicy.from_pretrained("me/saved", cache_dir=HOME / "fresh")


@pytest.fixture
def fresh(run, checkpoint, unimask):
    """A repository that has not been pulled to this machine."""
    unimask("push", f"--policy.path={checkpoint}", "--repo_id=me/fresh")
    shutil.rmtree(CACHE / "models--me--fresh", ignore_errors=True)
    return "me/fresh"


def test_a_cut_download_is_resumed(fresh):
    with HUB.fault(r"GET /storage/", times=1, cut=True):
        assert int(UniMASKPolicy.from_pretrained(fresh).updates) == 4


def test_a_download_that_breaks_off_leaves_nothing_that_looks_whole(fresh, refused, unimask):
    query = ["query", f"--policy.path={fresh}", "--mask=behavior_cloning", "--t=0", '--given={"s[0]": [0, 9]}']
    with HUB.fault(r"GET /storage/", times=1, cut=True), HUB.fault(r"GET /storage/", status=503):
        said = refused(*query)
    assert "me/fresh" in said
    assert "model.safetensors" not in blobs(fresh)
    assert not [name for name in blobs(fresh) if name.endswith(".incomplete")]
    unimask(*query)


@pytest.mark.parametrize("name", ["model.safetensors", "config.json"])
def test_a_damaged_file_is_noticed_and_not_kept(fresh, name, unimask):
    pattern = r"GET /storage/" if name == "model.safetensors" else r"GET /me/fresh/resolve/.*/config.json"
    with HUB.fault(pattern, damage=True), pytest.raises(HubError, match=f"{name}.*me/fresh"):
        UniMASKPolicy.from_pretrained(fresh)
    assert name not in blobs(fresh)
    assert int(UniMASKPolicy.from_pretrained(fresh).updates) == 4


def test_processors_that_name_code_are_not_loaded(fresh):
    ran = HOME / "ran"
    hostile = {"steps": [{"class": "subprocess.Popen", "config": {"args": ["touch", str(ran)]}}], "name": "p"}
    repository = HUB.model(fresh)
    files = dict(repository.commits[head(fresh)])
    files["policy_preprocessor.json"] = File(json.dumps(hostile).encode(), large=False)
    repository.commit(files, "hostile")
    flags = [
        "--env.type=doorkey",
        "--eval.n_episodes=1",
        "--eval.batch_size=1",
        f"--output_dir={HOME / 'eval_hostile'}",
    ]
    with pytest.raises(HubError, match=r"policy_preprocessor\.json.*me/fresh"):
        command("lerobot-eval", f"--policy.path={fresh}", *flags)
    assert not ran.exists()


def test_a_dataset_that_is_not_there_is_named(run):
    flags = ["--policy.type=unimask", "--policy.push_to_hub=false", "--dataset.repo_id=me/no_data", *SMALL, *TRAIN]
    with pytest.raises(Exception, match="me/no_data"):
        command("lerobot-train", *flags, "--steps=1", f"--output_dir={HOME / 'runs' / 'no_data'}")


# --- Offline ----------------------------------------------------------------------------------------------------------


@pytest.fixture
def offline(monkeypatch):
    monkeypatch.setattr(constants, "HF_HUB_OFFLINE", True)


def test_offline_what_was_pulled_works(run, checkpoint, unimask, monkeypatch):
    policy = UniMASKPolicy.from_pretrained("me/policy")
    asked = len(HUB.requests)
    monkeypatch.setattr(constants, "HF_HUB_OFFLINE", True)
    for ours, theirs in zip(answers(policy), answers(UniMASKPolicy.from_pretrained("me/policy")), strict=True):
        assert torch.equal(ours.nan_to_num(), theirs.nan_to_num())
    unimask("query", "--policy.path=me/policy", "--dataset.repo_id=me/doorkey", "--episode=0", "--mask=future", "--t=2")
    flags = ["--env.type=doorkey", "--eval.n_episodes=1", "--eval.batch_size=1", f"--output_dir={HOME / 'eval_off'}"]
    command("lerobot-eval", "--policy.path=me/policy", *flags)
    tuned = HOME / "runs" / "offline"
    flags = ["--policy.path=me/policy", "--policy.push_to_hub=false", *TRAIN, "--steps=1", f"--output_dir={tuned}"]
    command("lerobot-train", *flags, "--dataset.repo_id=me/doorkey")
    assert len(HUB.requests) == asked


def test_offline_what_was_not_pulled_ends_in_one_sentence(run, checkpoint, refused, offline):
    said = refused("query", "--policy.path=you/policy", "--mask=future", "--t=2")
    assert "you/policy" in said
    assert "HF_HUB_OFFLINE" in said
    with pytest.raises(HubError, match="HF_HUB_OFFLINE=1"):
        UniMASKPolicy.from_pretrained("you/policy")
    with pytest.raises(HubError, match="you/policy"):
        command("lerobot-eval", "--policy.path=you/policy", "--env.type=doorkey")
    said = refused("push", f"--policy.path={checkpoint}", "--repo_id=me/offline")
    assert "HF_HUB_OFFLINE=1" in said
    assert "me/offline" in said
    flags = ["--policy.type=unimask", "--policy.push_to_hub=false", "--dataset.repo_id=you/data", *SMALL, *TRAIN]
    with pytest.raises(HubError, match="you/data"):
        command("lerobot-train", *flags, "--steps=1", f"--output_dir={HOME / 'runs' / 'no_data'}")


# --- In the end -------------------------------------------------------------------------------------------------------


def test_no_other_address_was_called(run):
    assert ELSEWHERE == []
    hosts = {request.host.split(":")[0] for request in HUB.requests}
    assert hosts == {"127.0.0.1", "localhost"}
    assert len(HUB.requests) > 100
