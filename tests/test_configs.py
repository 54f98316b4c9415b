"""Every configuration in conf/ can be composed, and every class named in it takes the values given to it."""

import pytest

from pipeline.fingerprint import targets
from pipeline.flow import STAGES
from pipeline.settings import CONF, GROUPS, choices, compose
from pipeline.stage import build

CASES = [[]]
CASES += [[f"{group}={name}"] for group in GROUPS for name in choices(group)]
CASES += [
    [f"method={method}", f"scene={scene}", "profile=smoke"]
    for method in choices("method")
    for scene in choices("scene")
]


@pytest.mark.parametrize("words", CASES, ids=" ".join)
def test_configuration_builds_every_stage(words):
    config, picked = compose(words)
    for word in words:
        group, _, name = word.partition("=")
        assert picked[group] == name
    for name in STAGES:
        if config[name] is not None:
            stage = build(config[name], "cpu", name)
            assert callable(stage)
            assert f"{type(stage).__module__}.{type(stage).__name__}" == config[name]["_target_"]
    if config["learn"] is not None:
        start = config["material"]["start"]
        assert set(config["material"]["learn"]) <= set(start), "only a parameter with a start can be learned"
    assert targets(config), "nothing is named"


@pytest.mark.parametrize("method", choices("method"))
def test_a_method_is_kept_whatever_the_profile(method):
    """A profile is put below the method: it must not bring back what the method takes away."""
    plain, _ = compose([f"method={method}"])
    for profile in choices("profile"):
        config, _ = compose([f"method={method}", f"profile={profile}"])
        assert {n for n in STAGES if config[n] is None} == {n for n in STAGES if plain[n] is None}
        assert config["material"]["model"] == plain["material"]["model"]


def test_every_file_says_what_it_is():
    """The first comment is what --help shows."""
    for path in sorted(CONF.rglob("*.yaml")):
        comments = [line for line in path.read_text().splitlines() if line.startswith("# ") and "@package" not in line]
        assert comments, f"{path.relative_to(CONF)} needs a first line that says what it is"
