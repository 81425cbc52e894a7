"""``lerobot-swr-train``: many seeds at once, each as ``lerobot-train`` would train it."""

import re
import shutil
from pathlib import Path

import pytest
import torch
from conftest import OBSERVATIONS, SMALL_MAZE, make_batch, train_flags
from lerobot.configs import PreTrainedConfig
from lerobot.configs.default import DatasetConfig
from lerobot.datasets import EpisodeAwareSampler
from lerobot.policies.factory import get_policy_class, make_policy_config
from lerobot.scripts import lerobot_eval
from safetensors.torch import load_file
from training_command import assert_same_checkpoint

from lerobot_swr.cli import train as train_command
from lerobot_swr.corrective.inverse_model import fit_inverse_model
from lerobot_swr.demos.dataset_writer import write_dataset
from lerobot_swr.demos.maze2d import _recipe, steady
from lerobot_swr.policies.backbones.configuration_mlp import MLPConfig
from lerobot_swr.training import early_updates
from lerobot_swr.training.configuration_training import SeedsTrainConfig
from lerobot_swr.training.frame_order import FrameOrder
from lerobot_swr.training.seed_runs import SeedRuns
from lerobot_swr.training.stacked_policies import StackedPolicies
from lerobot_swr.training.traced_gradients import TracedGradients

SMALL = ("--policy.backbone.hidden_dim=16", "--policy.backbone.num_hidden=2", "--log_freq=5")


def weights(run: Path, step: int) -> dict[str, torch.Tensor]:
    """The saved tensors of a run's checkpoint."""
    return load_file(run / "checkpoints" / f"{step:06d}" / "pretrained_model" / "model.safetensors")


def test_frames_come_in_lerobots_order():
    """Three epochs, with a smaller last batch, against LeRobot's sampler frame by frame."""
    starts, ends = [0, 7, 19, 25], [7, 19, 25, 40]
    sampler = EpisodeAwareSampler(starts, ends, [0, 2, 3], shuffle=True, seed=5)
    expected = [list(sampler) for _ in range(3)]
    order = FrameOrder(starts, ends, [0, 2, 3], seed=5, batch_size=8)
    step, shown = 0, []
    while step < 3 * order.steps_per_epoch:
        rows = order.steps(step, 3)
        step += len(rows)
        shown += rows.flatten().tolist()
    assert shown == [row for epoch in expected for row in epoch]
    assert order.steps(2, 5).shape == (1, 8)
    assert order.steps(3, 5).shape == (1, 4)


def stack_lessons(lessons):
    """Their tensors, (K, B, ...), as training stacks them."""
    parts = [lesson.tensors([*OBSERVATIONS, "action"]) for lesson in lessons]
    return {key: torch.stack([part[key] for part in parts]) for key in parts[0]}


@pytest.mark.parametrize(
    ("policy_type", "options"),
    [
        ("bc", {}),
        ("zbc", {}),
        ("wzbc", {}),
        ("wzbc", {"partner_sampling": "uniform", "backbone": MLPConfig(16, 3, residual=False)}),
        ("zbc", {"style_init": "similarity", "style_dim": 2}),
        (
            "zbc",
            {
                "backbone": MLPConfig(16, 3, encoder="objects"),
                "dimension_names": {
                    "observation.state": ["x", "y"],
                    "observation.environment_state": ["goal.x", "goal.y"],
                },
            },
        ),
    ],
)
def test_losses_and_gradients_are_those_of_a_single_policy(make_tiny_policy, policy_type, options):
    """On the same batch and partners, parameter by parameter."""
    policies = [make_tiny_policy(policy_type, seed=seed, **options).train() for seed in range(3)]
    optimizers = [p.config.get_optimizer_preset().build(p.get_optim_params()) for p in policies]
    drawn = [policy.draw(make_batch(seed=k)) for k, policy in enumerate(policies)]
    config = type("Run", (), {"optimizer": policies[0].config.get_optimizer_preset(), "scheduler": None})()
    stack = StackedPolicies(policies, optimizers, None, config)
    stacked = stack_lessons(drawn)
    losses, gradients = stack.losses_and_gradients(stacked)
    for k, policy in enumerate(policies):
        loss = policy.loss(drawn[k])[0]
        loss.backward()
        torch.testing.assert_close(losses[k], loss)
        for name, parameter in policy.named_parameters():
            if parameter.requires_grad:
                torch.testing.assert_close(gradients[name][k], parameter.grad, rtol=1e-4, atol=1e-7)


def test_a_parameter_is_handed_over_when_nothing_needs_it_any_more():
    """Whatever takes a gradient may spoil its parameter: the other gradients are right all the same."""
    generator = torch.Generator().manual_seed(0)
    values = {name: torch.randn(2, 3, 3, generator=generator).requires_grad_() for name in "abc"}
    inputs = {"x": torch.randn(2, 3, 3, generator=generator)}

    def losses(parameters, drawn):
        # The gradient of each is made of the others, and of b by way of a view.
        product = parameters["a"] * parameters["b"].transpose(1, 2) * parameters["c"]
        return (product * drawn["x"]).sum(dim=(1, 2))

    expected = torch.autograd.grad(losses(values, inputs).sum(), list(values.values()))
    taken = {}

    def spoil(name):
        def consume(gradient):
            taken[name] = gradient.clone()
            values[name].detach().fill_(float("nan"))

        return consume

    descent = TracedGradients(losses, values, {name: spoil(name) for name in values})
    descent(inputs)
    for name, gradient in zip(values, expected, strict=True):
        torch.testing.assert_close(taken[name], gradient)


def test_gradients_are_clipped_policy_by_policy(make_tiny_policy):
    """A large gradient of one policy is cut to the limit and leaves the other policy's alone."""
    policies = [make_tiny_policy("zbc", seed=seed, optimizer_grad_clip_norm=1.0).train() for seed in range(2)]
    drawn = [policy.draw(make_batch(seed=k)) for k, policy in enumerate(policies)]
    drawn[0].weight.mul_(0.1)
    drawn[1].weight.mul_(1000)
    optimizers = [p.config.get_optimizer_preset().build(p.get_optim_params()) for p in policies]
    config = type("Run", (), {"optimizer": policies[0].config.get_optimizer_preset(), "scheduler": None})()
    stack = StackedPolicies(policies, optimizers, None, config)
    stack.step(stack_lessons(drawn))
    for policy, optimizer, one in zip(policies, optimizers, drawn, strict=True):
        policy.loss(one)[0].backward()
        norm = torch.nn.utils.clip_grad_norm_(policy.parameters(), 1.0)
        assert (norm > 1) == (one is drawn[1])
        optimizer.step()
    moments = [stack.optimizer_state(k)["state"] for k in range(2)]
    for k, optimizer in enumerate(optimizers):
        for i, state in optimizer.state_dict()["state"].items():
            torch.testing.assert_close(moments[k][i]["exp_avg"], state["exp_avg"], rtol=1e-4, atol=1e-8)
            assert moments[k][i]["step"] == state["step"] == 1


@pytest.mark.parametrize(
    ("policy_type", "options"),
    [("bc", ()), ("zbc", ()), ("wzbc", ()), ("wzbc", ("--policy.corrective=demos",))],
)
def test_a_seed_is_trained_as_lerobot_train_does(
    monkeypatch, swr_train, small_maze, tmp_path, policy_type, options
):
    """Beside LeRobot's own loop: same initial weights, frames, pairs and updates over more than an epoch."""
    monkeypatch.setattr(early_updates, "SMALL", 1)  # networks of a usual size are updated early
    flags = [*SMALL, *options, "--policy.flush_denormal=false"]
    alone = ("--stack=false", "--seeds=3", "--jobs=1")
    swr_train(*train_flags(policy_type, small_maze, tmp_path / "one", 70, *flags, *alone))
    swr_train(*train_flags(policy_type, small_maze, tmp_path / "all", 70, *flags, "--seeds=1,3", "--jobs=1"))
    expected, found = weights(tmp_path / "one" / "seed_3", 70), weights(tmp_path / "all" / "seed_3", 70)
    assert expected.keys() == found.keys()
    for name, value in expected.items():
        torch.testing.assert_close(found[name], value, rtol=1e-3, atol=1e-5, msg=name)


def test_a_seed_trained_alone_equals_that_seed_among_others(monkeypatch, swr_train, small_maze, tmp_path):
    """Bit for bit, training state included, in one process or in several, updated early or late."""
    common = ("wzbc", small_maze)
    with monkeypatch.context() as patch:
        patch.setattr(early_updates, "SMALL", 1)
        swr_train(*train_flags(*common, tmp_path / "alone", 40, *SMALL, "--seeds=2", "--jobs=1"))
    swr_train(*train_flags(*common, tmp_path / "five", 40, *SMALL, "--seeds=0,1,2,3,4", "--jobs=2"))
    last = Path("seed_2") / "checkpoints" / "000040"
    assert_same_checkpoint(tmp_path / "alone" / last, tmp_path / "five" / last)
    assert (
        weights(tmp_path / "five" / "seed_0", 40).keys() == weights(tmp_path / "five" / "seed_4", 40).keys()
    )


def test_lerobot_train_goes_on_from_a_seeds_checkpoint(
    lerobot_train_command, swr_train, small_maze, tmp_path
):
    """--resume=true of LeRobot's own command, to the weights that this command ends with."""
    flags = [*SMALL, "--save_freq=10", "--seeds=4,7", "--jobs=1", "--policy.flush_denormal=false"]
    swr_train(*train_flags("wzbc", small_maze, tmp_path / "run", 30, *flags))
    expected = weights(tmp_path / "run" / "seed_7", 30)
    config = tmp_path / "run/seed_7/checkpoints/000010/pretrained_model/train_config.json"
    lerobot_train_command(f"--config_path={config}", "--resume=true")
    for name, value in weights(tmp_path / "run" / "seed_7", 30).items():
        torch.testing.assert_close(value, expected[name], rtol=1e-3, atol=1e-5, msg=name)


def test_finished_seeds_are_left_alone_and_new_ones_added(swr_train, small_maze, tmp_path):
    """A second command with more seeds trains only those that are missing."""
    flags = train_flags("zbc", small_maze, tmp_path / "run", 10, *SMALL, "--jobs=1")
    swr_train(*flags, "--seeds=0")
    file = tmp_path / "run/seed_0/checkpoints/000010/pretrained_model/model.safetensors"
    before = file.stat().st_mtime_ns
    swr_train(*flags, "--seeds=0,1", "--resume=true")
    assert file.stat().st_mtime_ns == before
    assert weights(tmp_path / "run" / "seed_1", 10)


def test_episodes_that_are_left_out_get_no_style(swr_train, small_maze, tmp_path):
    """--dataset.episodes: only these episodes' styles are trained."""
    flags = [*SMALL, "--dataset.episodes=[1,4,5]", "--seeds=0,1", "--jobs=1"]
    swr_train(*train_flags("wzbc", small_maze, tmp_path / "run", 60, *flags))
    folder = tmp_path / "run/seed_1/checkpoints/last/pretrained_model"
    config = PreTrainedConfig.from_pretrained(folder)
    policy = get_policy_class(config.type).from_pretrained(folder, config=config)
    assert policy.styles.trained.tolist() == [0, 1, 0, 0, 1, 1]


def test_the_dynamics_are_those_of_the_runs_episodes(small_maze, small_maze_meta, tmp_path, monkeypatch):
    """Whatever the flags of the program mean that trains seeds from Python."""
    monkeypatch.setattr("sys.argv", ["program", "--dataset.episodes=[0,2]"])
    dataset = DatasetConfig("local/small_maze", root=str(small_maze), episodes=[1, 4, 5])
    policy = make_policy_config(
        "zbc", device="cpu", push_to_hub=False, backbone=MLPConfig(16), corrective="noise"
    )
    config = SeedsTrainConfig(dataset, policy=policy, output_dir=tmp_path / "run", seeds=[0], jobs=1)
    config.validate()
    (made,) = SeedRuns(config, [0], small_maze_meta).policies
    expected = fit_inverse_model(made.trajectories.subset([1, 4, 5])).r2
    assert made.config.inverse_r2 == pytest.approx(expected, abs=1e-4)


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        (("--seeds=1,1",), r"seeds=\[1, 1\]"),
        (
            ("--policy.type=act", "--dataset.streaming=true"),
            "streaming: not available in .*; switch off, or use",
        ),
        (("--dataset.eval_split=0.2", "--eval_steps=5"), "eval_steps: not available"),
        (("--jobs=0",), "jobs=0"),
        (("--seed=7",), "seed=7: this command takes --seeds=7"),
        (("--save_checkpoint=false",), "save_checkpoint=false: not available"),
    ],
)
def test_the_impossible_is_refused_before_training(swr_train, small_maze, tmp_path, capfd, flags, message):
    """The message names key, value and way out; nothing is written."""
    kept = train_flags("wzbc", small_maze, tmp_path / "run", 5)
    keys = {flag.partition("=")[0] for flag in flags}
    with pytest.raises(SystemExit):
        swr_train(*[flag for flag in kept if flag.partition("=")[0] not in keys], *flags)
    assert re.search(message, capfd.readouterr().err)
    assert not (tmp_path / "run").exists()


def test_an_existing_folder_and_changed_options_are_refused(swr_train, small_maze, tmp_path, capfd):
    """Without --resume the folder must be new; with it the options must be those that it was begun with."""
    flags = train_flags("zbc", small_maze, tmp_path / "run", 6, *SMALL, "--seeds=0", "--jobs=1")
    swr_train(*flags)
    with pytest.raises(SystemExit):
        swr_train(*flags)
    assert "--resume=true" in capfd.readouterr().err
    with pytest.raises(SystemExit):
        swr_train(*flags, "--resume=true", "--policy.style_dim=4")
    assert "other values of policy" in capfd.readouterr().err
    with pytest.raises(SystemExit):
        swr_train(*flags, "--resume=true", "--cudnn_deterministic=true")
    assert "other values of cudnn_deterministic" in capfd.readouterr().err


def test_a_fine_tuned_run_resumes_and_each_seed_draws_its_own_pairs(swr_train, small_maze, tmp_path):
    """From another dataset's checkpoint: interrupted and resumed to the same weights, a seed added later."""
    write_dataset(_recipe("other", "small", {"10": 2, "20": 2}, steady), tmp_path / "other", seed=9)
    swr_train(
        *train_flags("wzbc", tmp_path / "other", tmp_path / "base", 12, *SMALL, "--seeds=0", "--jobs=1")
    )
    base = tmp_path / "base/seed_0/checkpoints/last/pretrained_model"
    flags = [
        flag for flag in train_flags("wzbc", small_maze, tmp_path / "run", 20) if "policy.type" not in flag
    ]
    flags = [f"--policy.path={base}", *flags, "--save_freq=10", "--seeds=1,2", "--jobs=1"]
    swr_train(*flags)
    expected = {seed: weights(tmp_path / "run" / f"seed_{seed}", 20) for seed in (1, 2)}
    for seed in (1, 2):
        assert int(expected[seed]["relabel.draws.seed"]) == seed
        assert len(expected[seed]["styles.embedding.weight"]) == 6
    shutil.rmtree(tmp_path / "run/seed_2/checkpoints/000020")
    swr_train(*flags[:-2], "--seeds=1,2,3", "--jobs=1", "--resume=true")
    for name, value in weights(tmp_path / "run/seed_2", 20).items():
        assert torch.equal(value, expected[2][name]), name
    assert int(weights(tmp_path / "run/seed_3", 20)["relabel.draws.seed"]) == 3


def test_very_many_styles_resume(swr_train, small_maze, tmp_path, monkeypatch):
    """Where single runs step styles by rows, a stacked run's checkpoint says so, and goes on to the same."""
    monkeypatch.setattr("lerobot_swr.policies.style_policy.FROM_ROWS", 2)
    flags = train_flags(
        "zbc", small_maze, tmp_path / "run", 4, *SMALL, "--seeds=0", "--jobs=1", "--save_freq=2"
    )
    swr_train(*flags)
    expected = weights(tmp_path / "run/seed_0", 4)
    shutil.rmtree(tmp_path / "run/seed_0/checkpoints/000004")
    swr_train(*flags, "--resume=true")
    for name, value in weights(tmp_path / "run/seed_0", 4).items():
        torch.testing.assert_close(value, expected[name], rtol=1e-5, atol=1e-7)


def test_resuming_on_a_changed_dataset_is_refused(swr_train, small_maze, tmp_path, capfd):
    """The same folder with other demonstrations: an error, not another training."""
    root = tmp_path / "data"
    shutil.copytree(small_maze, root)
    flags = [
        *train_flags("zbc", root, tmp_path / "run", 20, *SMALL),
        "--save_freq=10",
        "--seeds=0",
        "--jobs=1",
    ]
    swr_train(*flags)
    shutil.rmtree(tmp_path / "run/seed_0/checkpoints/000020")
    write_dataset(_recipe("small_maze", "small", SMALL_MAZE, steady), root, seed=5, overwrite=True)
    with pytest.raises(SystemExit):
        swr_train(*flags, "--resume=true")
    assert "is not the dataset of the checkpoint" in capfd.readouterr().err


def test_a_command_that_failed_at_its_start_can_be_corrected(swr_train, small_maze, tmp_path, capfd):
    """No checkpoint was written, so other options are welcome in the same folder."""
    flags = train_flags("wzbc", small_maze, tmp_path / "run", 4, *SMALL, "--seeds=0", "--jobs=1")
    with pytest.raises(SystemExit):
        swr_train(*flags, '--policy.data.similarity_keys=["observation.speed"]')
    assert "observation.speed" in capfd.readouterr().err
    swr_train(*flags)
    assert weights(tmp_path / "run/seed_0", 4)


def test_lerobot_eval_rolls_a_seed_out(swr_train, run_command, small_maze, tmp_path):
    """The folder of a seed is a checkpoint like any other."""
    flags = train_flags("wzbc", small_maze, tmp_path / "run", 4, *SMALL, "--seeds=3", "--jobs=1")
    swr_train(*flags)
    run_command(
        lerobot_eval.main,
        f"--policy.path={tmp_path / 'run/seed_3/checkpoints/last/pretrained_model'}",
        *(
            "--env.type=maze2d",
            "--env.task=small",
            "--env.episode_length=12",
            "--eval.n_episodes=1",
            "--eval.batch_size=1",
        ),
        f"--output_dir={tmp_path / 'eval'}",
    )
    assert (tmp_path / "eval" / "eval_info.json").is_file()


def test_the_last_link_is_mended(swr_train, small_maze, tmp_path):
    """A kill between a checkpoint and its link: the next command points to the last checkpoint again."""
    flags = [
        *train_flags("zbc", small_maze, tmp_path / "run", 6, *SMALL),
        "--save_freq=3",
        "--seeds=0",
        "--jobs=1",
    ]
    swr_train(*flags)
    link = tmp_path / "run/seed_0/checkpoints/last"
    link.unlink()
    link.symlink_to("000003")
    swr_train(*flags, "--resume=true")
    assert link.resolve().name == "000006"


def test_seeds_are_read_in_every_form():
    """With an equals sign or a space, with brackets or without."""
    forms = (["--seeds=0,1"], ["--seeds", "0,1"], ["--seeds=[0,1]"])
    for form in forms:
        assert list(train_command._with_brackets(["x", *form, "--steps=3"])) == [
            "x",
            "--seeds=[0,1]",
            "--steps=3",
        ]
