"""Which cells a suite of the paper's experiments has, under which settings and names, and what is refused."""

import dataclasses
import itertools
from pathlib import Path

import draccus
import pytest
from lerobot.configs import PreTrainedConfig
from lerobot.configs.train import TrainPipelineConfig

from lerobot_swr.reproduction import execution
from lerobot_swr.reproduction.baselines import BASELINES, known_policies
from lerobot_swr.reproduction.demonstrations import HUMAN_DATASETS
from lerobot_swr.reproduction.experiments import evaluation, training, variant_name
from lerobot_swr.reproduction.measurement import environment_seed
from lerobot_swr.reproduction.settings import MAX_ROLLOUTS, SUITES, ReproductionSettings
from lerobot_swr.reproduction.suites import suite_cells, suite_datasets

CONFIGS = Path(__file__).parent.parent / "configs"


def test_names_tell_what_differs(settings, demos):
    """Numbers short, words as they are; options of the settings, too."""
    differing = {"beta": 3.0, "corrective": "demos", "backbone.residual": False, "style_dim": 4}
    assert variant_name("wzbc", differing) == "wzbc beta=3 corrective=demos residual=False style_dim=4"
    assert training(settings, demos, "zbc").labels.policy == "zbc hidden_dim=16"
    both = training(settings, demos, "zbc", {"corrective": "demos"})
    assert both.labels.policy == "zbc hidden_dim=16 corrective=demos"


def test_contracting_shares_its_plain_trainings_and_their_measurements(settings, demos):
    """All that robustness measures on zbc and wzbc is the same cell; corrective ones train as long."""
    suites = {name: set(suite_cells(name, settings, [demos])) for name in ("robustness", "contracting")}
    plain = {cell for cell in suites["robustness"] if cell.labels.policy.split(" ")[0] in ("zbc", "wzbc")}
    assert plain <= suites["contracting"]
    trained = [cell for cell in suites["contracting"] if cell.kind == "train"]
    chosen = sorted((c.definition["policy"], c.definition["config"]["corrective"]) for c in trained)
    corrective = [("wzbc", "noise"), ("zbc", "demos"), ("zbc", "noise")]
    assert chosen == sorted([("wzbc", "none"), ("zbc", "none"), *corrective])
    assert {(c.definition["steps"], c.definition["batch_size"]) for c in trained} == {(20, 16)}


def test_the_other_wzbc_are_trained_on_spread_out_alone(settings, demos):
    """p = 0.95 and beta = 3 in the suite robustness."""
    named = {
        name: {cell.labels.policy for cell in suite_cells("robustness", settings, [d])}
        for name, d in (("a", demos), ("b", dataclasses.replace(demos, name="medium_maze-spread_out")))
    }
    assert {policy.replace(" hidden_dim=16", "") for policy in named["b"] - named["a"]} == {
        "wzbc p=0.95",
        "wzbc beta=3",
    }


def test_the_arms_tasks_are_perturbed_as_their_environment_offers(settings, demos):
    """Shifted starts, noisy actions and, for aligning, a pushed box; the plain task first."""
    for task, pushes in (("avoiding", set()), ("aligning", {0.02, 0.05})):
        arm = dataclasses.replace(demos, env={"type": "d3il", "task": task})
        cells = [c for c in suite_cells("contracting", settings, [arm]) if c.labels.policy == "playback"]
        envs = [cell.definition["env"] for cell in cells]
        assert cells[0].labels.condition == "deterministic"
        assert {env["start_radius"] for env in envs} == {0.0, 0.02, 0.04}
        assert {env["action_noise"] for env in envs} == {0.0, 0.002, 0.004}
        assert {env["box_push"] for env in envs} == {0.0} | pushes


def test_robustness_perturbs_the_arm_as_contracting_does(settings, demos):
    """What both suites measure on zbc and wzbc is the same cell; a similarity cell tells who teaches whom."""
    arm = dataclasses.replace(demos, env={"type": "d3il", "task": "avoiding"})
    suites = {name: suite_cells(name, settings, [arm]) for name in ("robustness", "contracting")}
    styled = {c for c in suites["robustness"] if c.labels.policy.split(" ")[0] in ("zbc", "wzbc")}
    assert styled <= set(suites["contracting"])
    assert {c.labels.policy.split(" ")[0] for c in suites["robustness"]} == {"bc", "zbc", "wzbc", ""}


def test_aligning_is_measured_in_new_scenes_and_in_one(settings, demos):
    """Table 1 has both protocols where every episode draws a scene, and one where none does."""
    settings = dataclasses.replace(settings, policies=["bc", "zbc"])
    for task, expected in (("avoiding", ["deterministic"]), ("aligning", ["deterministic", "one scene"])):
        arm = dataclasses.replace(demos, env={"type": "d3il", "task": task})
        cells = [c for c in suite_cells("table1", settings, [arm]) if c.kind == "evaluate"]
        for policy in ("bc hidden_dim=16", "zbc hidden_dim=16"):
            of_it = [c for c in cells if c.labels.policy == policy]
            assert [c.labels.condition for c in of_it] == expected
            assert [c.definition.get("one_scene", False) for c in of_it] == [False, True][: len(expected)]


def test_scenes_are_told_apart_in_a_suite_of_their_own(settings, demos):
    """Every policy in own scenes and new ones, wzbc also with beta 2; a dataset of one scene is refused."""
    mazes = dataclasses.replace(demos, env={"type": "maze2d", "task": "scenes"})
    cells = [c for c in suite_cells("scenes", settings, [mazes]) if c.kind == "evaluate"]
    named = [c.labels.policy.replace(" hidden_dim=16", "") for c in cells]
    baselines = [name for name in ("bc", "act", "diffusion", "beso") if name in known_policies()]
    embedded = [name for name in dict.fromkeys(named) if "style_init=similarity" in name]
    plain = [name for name in dict.fromkeys(named) if name not in embedded]
    assert plain == [*baselines, "zbc", "wzbc", "wzbc beta=2"]
    assert [name.split(" ")[0] for name in embedded] == ["zbc", "wzbc"]
    assert ["corrective=noise" in name for name in embedded] == [False, True]
    assert [c.definition["scenes"] for c in cells] == ["own", "new"] * (len(cells) // 2)
    assert set(suite_datasets("scenes", settings)) == {"scenes_maze-two_ways", "scenes_large_maze-six_ways"}
    with pytest.raises(ValueError, match="every episode of its environment has the same scene"):
        suite_cells("scenes", settings, [demos])


def test_human_recordings_join_where_their_folder_is_given(tmp_path):
    """First in table1, robustness and contracting; without the folder no suite has them."""
    without, given = (ReproductionSettings(from_d3il=folder) for folder in (None, tmp_path))
    for suite in SUITES:
        assert not set(suite_datasets(suite, without)) & set(HUMAN_DATASETS)
    assert suite_datasets("table1", given)[:2] == tuple(HUMAN_DATASETS)
    assert suite_datasets("robustness", given)[0] == suite_datasets("contracting", given)[0]
    assert suite_datasets("control", given) == suite_datasets("control", without)


def test_human_datasets_ask_for_their_folder(tmp_path):
    """The recordings are not part of the package."""
    wanted = ReproductionSettings(suite="table1", datasets=["d3il_human_avoiding"], output_dir=tmp_path)
    with pytest.raises(ValueError, match=r"'d3il_human_avoiding' is made of .* --from_d3il=FOLDER"):
        execution.reproduce(wanted)


def test_every_style_is_used_equally_often(settings, demos):
    """Stratified rollouts are a multiple of the demonstrations, unless there are more of these."""
    for n_rollouts, expected in ((12, 12), (17, 12), (5, 5)):
        changed = dataclasses.replace(settings, n_rollouts=n_rollouts)
        one = evaluation(changed, demos, training(changed, demos, "zbc"), "x")
        assert one.definition["protocols"] == {"uniform": n_rollouts, "stratified": expected}


def test_policies_without_styles_are_rolled_out_once(settings, demos):
    """There is nothing to stratify."""
    one = evaluation(settings, demos, training(settings, demos, "bc"), "x")
    assert one.definition["protocols"] == {"uniform": 12}


def test_training_seeds_never_share_an_environment_seed():
    """However many rollouts are allowed."""
    first = [environment_seed(1000, seed) for seed in range(5)]
    assert all(b - a >= MAX_ROLLOUTS for a, b in itertools.pairwise(first))
    with pytest.raises(ValueError, match=r"n_rollouts=100001: expected at most 100,000"):
        ReproductionSettings(n_rollouts=MAX_ROLLOUTS + 1)


@pytest.mark.parametrize("name", [name for name in BASELINES if name in known_policies()])
def test_the_recipes_of_other_policies_are_those_of_the_configs(name):
    """configs/ and the suites train the same networks on batches of the same size."""
    recipe = TrainPipelineConfig.from_pretrained(CONFIGS / f"{name}.yaml")
    config = PreTrainedConfig.get_choice_class(name)(
        device="cpu", push_to_hub=False, **BASELINES[name].options
    )
    encoded = [draccus.encode(c, PreTrainedConfig) for c in (config, recipe.policy)]
    assert encoded[0] == encoded[1]
    assert recipe.batch_size == BASELINES[name].batch_size


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"suite": "table9"}, r"suite='table9': expected one of table1, "),
        ({"seeds": 0}, r"seeds=0: expected at least 1"),
        ({"policies": []}, r"policies=\[\]: nothing would be left"),
        ({"jobs": 0}, r"jobs=0"),
    ],
)
def test_bad_settings_are_named(options, message):
    """Before anything is made."""
    with pytest.raises(ValueError, match=message):
        ReproductionSettings(**options)


def test_unknown_datasets_and_policies_are_named(tmp_path):
    """With what there is instead."""
    with pytest.raises(ValueError, match=r"'maze9' is neither in .* nor one of the package's: medium_maze"):
        execution.reproduce(ReproductionSettings(suite="table1", datasets=["maze9"], output_dir=tmp_path))
    with pytest.raises(ValueError, match=r"policies=\['zcb'\]: unknown; this installation knows bc, zbc"):
        execution.reproduce(ReproductionSettings(policies=["zcb"], output_dir=tmp_path))


def test_an_option_that_a_policy_lacks_is_named(settings, demos):
    """bc has no styles: the key, the policy and the way out, not a stack trace."""
    settings = dataclasses.replace(settings, policy_options={"style_dim": 4})
    assert training(settings, demos, "zbc").definition["config"]["style_dim"] == 4
    with pytest.raises(ValueError, match=r"'bc' has no option 'style_dim'; .*--policies"):
        training(settings, demos, "bc")
