"""The config: validation, reading a dataset's features, the command line, and `config.json`."""

import json

import draccus
import pytest
from draccus.utils import ParsingError
from lerobot.configs import FeatureType, PolicyFeature, PreTrainedConfig
from lerobot.configs.train import TrainPipelineConfig

from lerobot_unimask import MaskError, UniMASKConfig
from lerobot_unimask.configuration_unimask import MOST
from lerobot_unimask.data.factors import Feature


def make(**settings):
    return UniMASKConfig(device="cpu", **settings)


def parse(*arguments):
    return draccus.parse(UniMASKConfig, args=["--device=cpu", *arguments])


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"token_layout": "heap"}, "token_layout.*'heap'.* stacked, separate"),
        ({"attention": "sideways"}, "attention.*'sideways'.* both, bidirectional, causal"),
        ({"causal_share": 1.0}, "causal_share.* 1.0.* 0 and 1"),
        ({"token_layout": "stacked"}, "token_layout=stacked needs attention=bidirectional"),
        ({"continuous_head": "median"}, "continuous_head.*'median'.* l2, gaussian, mixture"),
        *(({name: 0}, f"{name} is 0; it must lie in 1 to") for name in MOST),
        *(({name: 10**9}, f"{name} is 1000000000; it must lie in 1 to") for name in MOST),
        ({"chunk_size": 8}, "1 to 5, context_length. For more train with --policy.context_length=8 or more"),
        ({"chunk_size": 4, "n_action_steps": 5}, "n_action_steps.* 5.* 1 to 4.*chunk_size"),
        ({"n_obs_steps": 11}, "n_obs_steps.* 11.* 1 to 5.*context_length"),
        ({"width": 10, "heads": 4}, "width.*10.*heads.*4"),
        ({"dropout": 1.0}, "dropout is 1.0"),
        ({"dropout": -0.1}, "dropout is -0.1"),
        ({"loss_weights": {"rtg": 1.0}, "ask_properties": False}, "loss_weights names rtg"),
        ({"training_masks": []}, "training_masks is empty"),
        ({"training_masks": {"past": -1.0}}, "weights are positive"),
    ],
)
def test_a_setting_out_of_range_is_named(settings, message):
    with pytest.raises(ValueError, match=message):
        make(**settings)


@pytest.mark.parametrize("name", ["training_masks", "inference_mask"])
@pytest.mark.parametrize("text", ["a[t", "behaviour_cloning", "t[0]"])
def test_a_mask_that_does_not_parse_is_refused_at_once(name, text):
    with pytest.raises(MaskError) as raised:
        make(**{name: text})
    assert text in str(raised.value)


def test_windows_are_k_steps_from_the_sampled_frame_on():
    config = make(context_length=4)
    assert config.observation_delta_indices == config.action_delta_indices == [0, 1, 2, 3]
    assert config.reward_delta_indices is None
    assert config.drop_n_last_frames == 3
    assert make(context_length=4, drop_n_last_frames=0).drop_n_last_frames == 0


def test_presets():
    config = make(optimizer_lr=3e-4, scheduler_warmup_steps=7)
    assert config.get_optimizer_preset().lr == 3e-4
    assert config.get_scheduler_preset().num_warmup_steps == 7


# --- A dataset's features --------------------------------------------------------------------------------------------

ENTRIES = {
    "observation.state": {"dtype": "int64", "shape": (2,), "names": ["agent", "key"], "categories": [16, 16]},
    "observation.environment_state": {"dtype": "float32", "shape": (3,), "names": None},
    "observation.visits_corner": {"dtype": "float32", "shape": (1,), "names": None},
    "observation.images.top": {"dtype": "video", "shape": (8, 8, 3), "names": ["height", "width", "channels"]},
    "observation.text": {"dtype": "string", "shape": (1,), "names": None},
    "action": {"dtype": "float32", "shape": [2], "names": {"motors": ["x", "y"]}},
    "observation.return_to_go": {"dtype": "float32", "shape": (1,), "names": ["return_to_go"]},
    "next.reward": {"dtype": "float32", "shape": (1,), "names": None},
    "timestamp": {"dtype": "float32", "shape": (1,), "names": None},
    "index": {"dtype": "int64", "shape": (1,), "names": None},
}


def test_factors_are_read_off_a_dataset():
    config = make()
    config.set_dataset_feature_metadata(ENTRIES)
    assert config.features == {
        "s": [Feature("observation.state", 2, [16, 16]), Feature("observation.environment_state", 3)],
        "a": [Feature("action", 2)],
        "rtg": [Feature("observation.return_to_go", 1)],
    }
    assert config.features["s"][0].names == ["agent", "key"]


def test_a_checkpoint_goes_on_with_the_same_features_alone():
    config = make()
    config.set_dataset_feature_metadata(ENTRIES)
    config.set_dataset_feature_metadata(ENTRIES)
    renamed = ENTRIES | {"observation.state": ENTRIES["observation.state"] | {"names": None}}
    config.set_dataset_feature_metadata(renamed)  # names are for people
    other = ENTRIES | {"observation.state": ENTRIES["observation.state"] | {"categories": [16, 9]}}
    with pytest.raises(ValueError, match=r"\n.*\[16, 16\].*\n.*\[16, 9\]"):
        config.set_dataset_feature_metadata(other)


def test_categories_must_be_as_many_as_numbers():
    wrong = ENTRIES | {"observation.state": ENTRIES["observation.state"] | {"categories": [16]}}
    with pytest.raises(ValueError, match=r"observation\.state.* 2 .* 1 categories"):
        make().set_dataset_feature_metadata(wrong)


@pytest.mark.parametrize("key", ["action", "observation.state"])
def test_states_and_actions_are_needed(key):
    entries = {name: entry for name, entry in ENTRIES.items() if name not in (key, "observation.environment_state")}
    with pytest.raises(ValueError, match=f"no '{key}'"):
        make().set_dataset_feature_metadata(entries)
    declared = {"observation.state": FeatureType.STATE, "action": FeatureType.ACTION}
    features = {name: PolicyFeature(kind, (2,)) for name, kind in declared.items() if name != key}
    with pytest.raises(ValueError, match=f"no '{key}'"):
        make(input_features=features).validate_features()


@pytest.mark.parametrize("key", ["action", "observation.state"])
@pytest.mark.parametrize("dtype", ["string", "image"])
def test_texts_and_pictures_are_no_states_and_no_actions(key, dtype):
    entries = {name: entry for name, entry in ENTRIES.items() if name != "observation.environment_state"}
    entries[key] = {"dtype": dtype, "shape": (8, 8, 3) if dtype == "image" else (1,), "names": None}
    with pytest.raises(ValueError, match=f"no '{key}' of numbers"):
        make(cameras=[]).set_dataset_feature_metadata(entries)


def test_other_states_of_two_dimensions_are_said_to_be_ones():
    entries = {**ENTRIES, "observation.grid": {"dtype": "float32", "shape": (4, 4), "names": None}}
    with pytest.raises(ValueError, match=r"observation\.grid has shape \(4, 4\).*unimask prepare"):
        make(states=["observation.grid"]).set_dataset_feature_metadata(entries)


def test_declared_features_serve_where_no_dataset_was_read():
    config = make(
        input_features={
            "observation.state": PolicyFeature(FeatureType.STATE, (3,)),
            "observation.images.top": PolicyFeature(FeatureType.VISUAL, (3, 8, 8)),
        },
        output_features={"action": PolicyFeature(FeatureType.ACTION, (2,))},
    )
    config.validate_features()
    assert config.features == {"s": [Feature("observation.state", 3)], "a": [Feature("action", 2)]}
    config.output_features = {"action": PolicyFeature(FeatureType.ACTION, (9,))}
    config.validate_features()  # as at evaluation: what is known stays
    assert config.features["a"] == [Feature("action", 2)]


# --- The command line and config.json --------------------------------------------------------------------------------

MASKS = [
    ("past", "past"),
    ("a[t] | s[:t+1], a[:t]", "a[t] | s[:t+1], a[:t]"),
    ('["behavior_cloning", "s[1] | s[0], a[0]"]', ["behavior_cloning", "s[1] | s[0], a[0]"]),
    ('{"past": 1, "random_mask": 2.5}', {"past": 1.0, "random_mask": 2.5}),
]


@pytest.mark.parametrize(("argument", "value"), MASKS)
def test_training_masks_on_the_command_line(argument, value):
    assert parse(f"--training_masks={argument}").training_masks == value


def test_given_on_the_command_line():
    config = parse('--given={"s[-1]": [15, 15], "a[0]": 2, "s[3]": [[1, 2], [3, 4]]}', "--target_return=5")
    assert config.given == {"s[-1]": [15, 15], "a[0]": 2, "s[3]": [[1, 2], [3, 4]]}
    assert config.target_return == 5


@pytest.mark.parametrize("text", ["a[t] | s[:t+1], a[:t], s[-1]", "goal_conditioned"])
def test_inference_mask_on_the_command_line(text):
    assert parse(f"--inference_mask={text}").inference_mask == text


@pytest.mark.parametrize(("_", "masks"), MASKS)
def test_config_json_gives_the_settings_back(tmp_path, _, masks):
    given = {"s[-1]": [15, 14.5], "a[0]": [[1.0], [2]], "rtg[0]": 4}
    config = make(training_masks=masks, given=given, loss_weights={"s": 0.5})
    config.set_dataset_feature_metadata(ENTRIES)
    config._save_pretrained(tmp_path)
    loaded = PreTrainedConfig.from_pretrained(tmp_path)
    assert isinstance(loaded, UniMASKConfig)
    assert loaded == config
    assert loaded.training_masks == masks
    assert loaded.features["s"][0].names == ["agent", "key"]
    assert json.loads((tmp_path / "config.json").read_text())["training_masks"] == masks


def test_settings_can_be_changed_where_a_checkpoint_is_loaded(tmp_path):
    make(training_masks=["past", "future"])._save_pretrained(tmp_path)
    changed = PreTrainedConfig.from_pretrained(
        tmp_path, cli_overrides=["--training_masks=random_mask", '--given={"s[-1]": [1, 2]}', "--sample_actions=true"]
    )
    assert (changed.training_masks, changed.given, changed.sample_actions) == ("random_mask", {"s[-1]": [1, 2]}, True)


# --- Properties ------------------------------------------------------------------------------------------------------

CORNER = {"dtype": "int64", "shape": (1,), "names": None, "categories": [2]}
LABELLED = {
    "observation.state": {"dtype": "float32", "shape": (2,), "names": None},
    "action": {"dtype": "float32", "shape": (1,), "names": None},
    "observation.visits_corner": CORNER,
    "observation.labels.last": {"dtype": "float32", "shape": (2,), "names": ["x", "y"]},
    "observation.flag": {"dtype": "bool", "shape": (1,), "names": None},
    "corner": CORNER,
}


def with_properties(*properties, features=LABELLED):
    config = UniMASKConfig(device="cpu", properties=list(properties))
    config.set_dataset_feature_metadata(features)
    return config


def test_properties_become_factors_by_the_last_part_of_their_names():
    config = with_properties("observation.visits_corner", "observation.labels.last", "observation.flag")
    assert list(config.features) == ["s", "a", "visits_corner", "last", "flag"]
    assert config.features["visits_corner"] == [Feature("observation.visits_corner", 1, [2])]
    assert config.features["last"] == [Feature("observation.labels.last", 2)]
    assert config.features["flag"] == [Feature("observation.flag", 1, [2])]  # a truth value is one of two categories
    assert list(with_properties().features) == ["s", "a"]  # a label is no factor unless it is named


@pytest.mark.parametrize(
    ("properties", "message"),
    [
        (
            ["observation.corner"],
            r"observation\.visits_corner, .*unimask prepare",
        ),
        (["corner"], r"observation\.NAME"),
        (["observation.state"], r"observation\.state"),
        (["observation.visits_corner", "observation.visits_corner"], r"observation\.visits_corner"),
    ],
)
def test_what_cannot_be_a_property_is_refused(properties, message):
    with pytest.raises(ValueError, match=message):
        with_properties(*properties)


@pytest.mark.parametrize("name", ["s", "a", "t", "rtg"])
def test_the_names_of_the_language_are_taken(name):
    with pytest.raises(ValueError, match=f"observation.{name}"):
        with_properties(f"observation.{name}", features={**LABELLED, f"observation.{name}": CORNER})


def test_properties_are_saved_with_the_checkpoint(tmp_path):
    config = with_properties("observation.visits_corner")
    config._save_pretrained(tmp_path)
    loaded = PreTrainedConfig.from_pretrained(tmp_path)
    assert loaded.properties == ["observation.visits_corner"]
    assert loaded.features == config.features
    loaded.set_dataset_feature_metadata(LABELLED)  # fine-tuning on the same columns


@pytest.mark.parametrize(
    ("flag", "said"), [("--policy.chunk_size=6", "chunk_size is 6"), ("--policy.attention=up", "attention is 'up'")]
)
def test_the_command_line_says_why_a_setting_is_refused(flag, said):
    with pytest.raises(ParsingError, match=said):
        draccus.parse(TrainPipelineConfig, args=["--policy.type=unimask", "--dataset.repo_id=local/x", flag])
