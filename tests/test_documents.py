"""What a reader opens exists, and what a user copies parses."""

import json
import re
from pathlib import Path

import draccus
import pytest
import yaml
from lerobot.configs.train import TrainPipelineConfig

REPOSITORY = Path(__file__).parent.parent
DOCS = REPOSITORY / "docs"
PAGES = [*sorted(REPOSITORY.glob("*.md")), *sorted(DOCS.rglob("*.md"))]
TUTORIALS = ("maze", "so101")
CONFIGS = sorted((REPOSITORY / "configs").glob("*.yaml"))


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(REPOSITORY)))
def test_links_pictures_and_scripts_of_a_page_exist(page):
    """Every relative link and every script to run is a file of the repository."""
    text = page.read_text()
    targets = re.findall(r"\]\(([^)#]+)[^)]*\)", text)
    missing = [target for target in targets if "://" not in target and not (page.parent / target).exists()]
    scripts = re.findall(r"python ((?:docs|benchmarks)/\S+\.py)", text)
    missing += [script for script in scripts if not (REPOSITORY / script).is_file()]
    assert not missing


def test_every_page_has_its_place_on_the_site():
    """mkdocs.yml lists each page once; one that is not listed would fail `make docs`."""
    listed = re.findall(
        r"^ +- (?:[^:\n]+: )?(\S+\.md)$", (REPOSITORY / "mkdocs.yml").read_text(), re.MULTILINE
    )
    assert sorted(listed) == sorted(str(page.relative_to(DOCS)) for page in DOCS.rglob("*.md"))


def test_every_module_is_in_the_reference():
    """A new package or module of the first level is named on a page of docs/api."""
    named = set(
        re.findall(r"^::: lerobot_swr\.(\w+)$", "".join(p.read_text() for p in DOCS.glob("api/*.md")), re.M)
    )
    modules = {path.stem for path in (REPOSITORY / "lerobot_swr").iterdir() if not path.stem.startswith("_")}
    assert named == modules - {"py"}


def test_the_notebooks_are_the_tutorials():
    """`python -m docs.site.notebooks` was run after the page was changed; the blocks are the cells."""
    for tutorial in TUTORIALS:
        notebook = json.loads((REPOSITORY / "notebooks" / f"{tutorial}.ipynb").read_text())
        cells = ["".join(one["source"]) for one in notebook["cells"] if one["cell_type"] == "code"]
        page = (DOCS / "tutorials" / f"{tutorial}.md").read_text()
        blocks = re.findall(r"^```(python|bash)\n(.*?)\n```$", page, flags=re.DOTALL | re.MULTILINE)
        assert cells == [f"%%bash\n{code}" if language == "bash" else code for language, code in blocks]
        assert not any(one.get("outputs") for one in notebook["cells"])


def test_the_readme_is_short():
    """A stranger reads it to the end."""
    assert len((REPOSITORY / "README.md").read_text().splitlines()) <= 150


@pytest.mark.parametrize("config", CONFIGS, ids=lambda config: config.stem)
def test_a_recipe_is_understood_whole(config):
    """LeRobot's parser takes every key, and the run would keep its last step."""
    with config.open() as file:
        parsed = draccus.load(TrainPipelineConfig, file)
    written = yaml.safe_load(config.read_text())
    assert parsed.policy is not None
    for key, value in written["policy"].items():
        if key not in ("type", "normalization_mapping", "input_features"):
            read = getattr(parsed.policy, key)
            if key == "backbone":
                read = {"type": read.type, **vars(read)}
                read = {name: list(v) if isinstance(v, tuple) else v for name, v in read.items()}
                assert {name: str(v) for name, v in value.items()}.items() <= {
                    name: str(v) for name, v in read.items()
                }.items()
                continue
            assert (list(read) if isinstance(read, tuple) else read) == value, key
    assert parsed.steps % parsed.save_freq == 0


def test_the_papers_recipe_and_flags_are_the_same_policy():
    """configs/wzbc_paper.yaml and the flags of docs/method.md."""
    policy = yaml.safe_load((REPOSITORY / "configs" / "wzbc_paper.yaml").read_text())["policy"]
    flags = dict(re.findall(r"--policy\.([\w.]+)=(\S+)", (REPOSITORY / "docs" / "method.md").read_text()))
    assert str(policy["backbone"]["residual"]).lower() == flags["backbone.residual"]
    for key in ("lr_schedule", "style_init_scale", "style_lr_scale", "partner_sampling"):
        assert str(policy[key]).lower() == flags[key], key
