"""The config: mistakes name the key and the nearest fix before anything starts."""

from __future__ import annotations

import inspect
import random
from collections.abc import Iterator, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest
import yaml

from envs.targets import TARGET, ConfigError, _within, target
from pipeline.checks import faults
from pipeline.config import CONFIGS, choices, groups, load_config, read_config
from pipeline.loop import build_loop
from tests.sampling import every, those


@pytest.mark.parametrize(
    ("words", "match"),
    [
        (["rl.learningrate=1"], r"rl\.learningrate is not a key"),
        (["rl.minibach=1"], r"did you mean rl\.minibatch"),
        (["simulater=dit"], "simulator"),
        (["simulator.sampling.kind=edm"], r"no key of the simulator that is chosen, but of simulator=gesim"),
        (["seed=1,2"], r"seed=1,2 names several values.*seed=\[1,2\], or run each"),
        (["simulator=gan"], r"^simulator=gan is not a choice of configs/simulator; there are \['dit', "),
        (["experiment=metawrld5"], r"^experiment=metawrld5 is not a choice .*; did you mean metaworld5"),
        (["metaworld"], r"^metaworld is not a key; did you mean task=metaworld\?$"),
        (["experiment=smoke", "metawrld"], r"^metawrld is not a key; did you mean task=metaworld\?$"),
        (["task.horizon=41"], r"task\.horizon"),
        (["task.mode=sideways"], r"task\.mode"),
        (["collect.mix.expert=0.9"], r"collect\.mix"),
        (["rounds.deploy=[]"], r"rounds\.deploy"),
        (["rounds.count=20"], r"rounds\.count=20 should be less than 20"),
        (["rounds.splits.held_out=0.9"], r"rounds\.splits"),
        (["rl.shards=3"], r"rl\.shards"),
        (["+foo=1"], r"foo is not a key"),
        (["name=../../x"], r"name='\.\./\.\./x' should be"),
        (["evaluate.episodes=0"], r"evaluate\.episodes=0 should be greater than or equal to 1"),
        (["track.wandb=of"], r"track\.wandb='of' should be 'offline', 'online' or 'disabled'"),
        (["launch=ray", "launch.actors=-2"], r"launch\.actors=-2"),
        (["launch=ray", "launch.patience.job=0"], r"launch\.patience\.job=0"),
        (["policy.head.std=wide"], r"policy\.head\.std='wide' should be a valid number"),
        (["judge._target_=judges.Mine"], r"judge\._target_=judges\.Mine does not import"),
        (["algorithm=grpo", "rl.envs=40"], r"algorithm\.group"),
        (
            ["algorithm=grpo", "judge.rewards.progress=0"],
            r"rl\.horizon=8 cuts episodes short.*rl\.horizon=null",
        ),
        (["rl.rewards_later=true"], r"rl\.rewards_later=true, but algorithm=ppo"),
        (["rl.schedule=async", "rl.queue=2"], r"rl\.queue=2 must hold at least the rl\.shards=4"),
        (["imitation.fit.batch=7", "microbatches=2"], r"imitation\.fit: batch=7 must be a multiple of micro"),
        (["collect.noise_level=[0.6,0.1]"], r"collect\.noise_level"),
        (["simulator=null"], r"simulator=null cannot be read"),
        (["=3"], r"=3 names no key"),
        (["name="], r"name='' should have at least 1 character"),
        (["collect.episodes=5"], r"collect\.episodes"),
        (["launch.device=gpu"], r"launch\.device='gpu' should be auto, cpu, cuda or"),
        (["policy.head.mode=sideways"], r"policy\.head\.mode='sideways' should be 'relative' or"),
        (["simulator=dit", "simulator.denoising.prediction=noise"], r"denoising\.prediction='noise' should"),
        (
            ["distill.steps=2"],
            r"distill\.steps=2, but UNetSimulator does not denoise in steps.*simulator=dit",
        ),
        (["simulator=dit", "distill.steps=5"], r"more than the teacher's simulator\.denoising\.steps=4"),
        (["simulator=gesim", "task=lerobot", "task.data=[x]", "distill.steps=5"], r"GE-Sim takes at most 4"),
        (
            ["simulator=dit", "distill.steps=2", "distiller=dmd2_gesim", "distill.first.fit={lr: 1e-4}"],
            r"distill\.first\.fit\.lr=0\.0001 is more than 10 times .*say distill\.first\.fit\.lr=2e-06",
        ),
        (["distill.method.critic_lr=0"], r"distill\.method\.critic_lr=0"),
        (
            ["simulator=dit", "distill.steps=2", "distill.refresh.fit.steps=4"],
            r"distill\.refresh\.fit\.steps=4 end before the student's .*say distill\.refresh\.fit\.steps=5",
        ),
        (["+if_chosen.judge.learned.pionts=3"], r"if_chosen\.judge\.learned\.pionts is no option of"),
        (
            ["+if_chosen.jugde.learned.points=3"],
            r"if_chosen\.jugde is no group of choices; did you mean judge",
        ),
        (
            ["+if_chosen.task.tabeltop.horizon=8"],
            r"if_chosen\.task\.tabeltop is no choice of task; did you mean tabletop",
        ),
        (
            ["+if_chosen.task.dott.horizon=8", "hydra.searchpath=[file://examples/configs]"],
            r"if_chosen\.task\.dott is no choice of task; did you mean dot\?",
        ),
        (
            ["experiment=smoke", "task=dot", "rl.lr=[1,", "hydra.searchpath=[file://examples/configs]"],
            r"^rl\.lr=\[1, cannot be read",
        ),
        (["task=tabletop", "task.suite.scenes=3"], r"task\.suite\.scenes=3"),
        (["task=tabletop", "+task.variants.x={scene: a}"], r"task\.variants\.x\.scene is not an option"),
    ],
)
def test_mistakes_name_the_key(words: list[str], match: str) -> None:
    with pytest.raises(ConfigError, match=match):
        load_config(words)


def test_choices_and_options_of_ones_own_package_are_known(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = tmp_path / "chosen_here"
    (folder / "judge").mkdir(parents=True)
    for name in ("__init__.py", "judge/__init__.py"):
        (folder / name).touch()
    (folder / "its.py").write_text("class Mine:\n    def __init__(self, spec, hold: int, share=0.1): ...\n")
    text = "_target_: chosen_here.its.Mine\nhold: 2\nrewards: {progress: 1.0, success: 1.0}\n"
    (folder / "judge/mine.yaml").write_text(text)
    monkeypatch.syspath_prepend(str(tmp_path))
    found = ["hydra.searchpath=[pkg://chosen_here]", "+if_chosen.judge.mine.hold=3"]
    assert read_config([*found, "judge=mine"])["judge"]["hold"] == 3
    assert read_config(found)["judge"]["hold"] == 2
    for word, said in (
        ("judge.share=0.3", r"^judge\.share is an option .* not name; say \+judge\.share=0\.3$"),
        ("judge.shar=0.3", r"^judge\.shar is not a key"),
    ):
        with pytest.raises(ConfigError, match=said):
            read_config([*found, "judge=mine", word])
    assert read_config([*found, "judge=mine", "+judge.share=0.3"])["judge"]["share"] == 0.3


# What a choice cannot be without.
NEEDED = {"task=lerobot": ["task.data=[recordings]"], "judge=golden_goal_action": ["simulator=tokens"]}


def test_one_folder_of_data_needs_no_brackets() -> None:
    for key in ("task.data", "extra_starts.data", "finetune.data", "imagined.data"):
        section = key.partition(".")[0]
        for value, wanted in {"/my/data": ["/my/data"], "[a,b]": ["a", "b"], "[]": [], "": []}.items():
            words = ["task=lerobot", "task.data=[x]", f"{key}={value}"]
            assert read_config(words)[section]["data"] == wanted
    assert load_config(["task=lerobot", "task.data=my_data"])["task"]["data"] == ["my_data"]
    with pytest.raises(ConfigError, match=r"^task has neither a suite .* nor data"):
        load_config(["task=lerobot", "task.data="])
    cfg = read_config(["task=lerobot", "task.data=[x]"])
    assert any("task.data" in fault for fault in faults({**cfg, "task": {**cfg["task"], "data": "x"}}))


def test_options_of_a_choice_count_with_that_choice_alone() -> None:
    mine = ["+if_chosen.judge={proxy: {width: 4}, learned: {points: 7}}"]
    mine += ["+if_chosen.task={push: {suite: {hold: 0.2}}}"]
    proxy = load_config([*mine, "judge=proxy"])
    assert proxy["judge"]["width"] == 4 and "points" not in proxy["judge"]
    assert load_config(mine)["judge"]["points"] == 7 and proxy["task"]["suite"]["hold"] == 0.2
    assert load_config([*mine, "task=tabletop"])["task"]["suite"]["hold"] == 0.4
    told = load_config([*mine, "judge=proxy", "judge.width=5", "task.suite={hold: 0.3}"])
    assert (told["judge"]["width"], told["task"]["suite"]["hold"]) == (5, 0.3)
    for name in choices("judge"):  # an experiment's options of its own judge are no other's
        beside = NEEDED.get(f"judge={name}", [])
        assert load_config(["experiment=soak", f"judge={name}", *beside])["judge"]


def test_a_distiller_sets_the_learning_rates_of_student_and_critic() -> None:
    def rates(*words: str) -> list[float]:
        made = load_config(["simulator=dit", "distill.steps=2", *words])["distill"]
        return [made["method"]["critic_lr"], *(made[name]["fit"]["lr"] for name in ("first", "refresh"))]

    assert rates("distiller=dmd2") == rates() == [2e-4, 1e-4, 1e-4]
    assert rates("distiller=dmd2_gesim") == [2e-6, 2e-6, 2e-6]
    assert rates("distiller=dmd2_gesim", "distill.first.fit.lr=1e-5") == [2e-6, 1e-5, 2e-6]


def test_all_mistakes_are_told_at_once() -> None:
    with pytest.raises(ConfigError) as told:
        load_config(["rl.lr=-1", "seed=-3", "task.suite.control_hz=fast", "simulator.width=0"])
    for key in ("rl.lr", "seed", "task.suite.control_hz", "simulator.width"):
        assert f"\n{key}=" in f"\n{told.value}"


WRONG: dict[type, list[Any]] = {
    bool: ["perhaps", None, 3],
    int: ["many", None, -7, [1], {}],
    float: ["much", None, [1.0], float("nan"), float("inf")],
    str: [3, None, {}],
    list: [3, None, {}, {"a": 1}],
    dict: [3, None, "none", [1]],
}
# other packages' options; where null has a meaning
FREE = ("simulator.scratch", "policy.policy", "judge.chat.body")
NULLABLE = (
    "rl.horizon",
    "rl.recorded_rounds",
    "task.suite",
    "finetune.weights",
    "judge.chat.key",
    "algorithm.clip_numbers",
    "simulator.window",
    "simulator.horizon",
)


WHOLE = "experiment=quickstart"
CHOICES = [f"{group}={name}" for group in groups() for name in choices(group)]
SAMPLED = (WHOLE, "experiment=bench4", "simulator=dit", "judge=learned", "task=tabletop", "launch=ray")
SECTIONS = {"distiller": "distill"}  # of groups that fill a part of one


@pytest.mark.parametrize("word", those(SAMPLED, CHOICES))
def test_hundreds_of_wrong_values_are_all_found(word: str) -> None:
    """Every value of every choice in turn is replaced by values of other types and out of range; each is
    found and named. Experiments share most of theirs, which are tried once.
    """
    group = word.partition("=")[0]
    section = SECTIONS.get(group, group)
    cfg = load_config([word, *NEEDED.get(word, [])])
    tried, missed = 0, []
    # an experiment is the whole config
    known = {} if word == WHOLE or group != "experiment" else dict(leaves(load_config([WHOLE])))
    for path, value in leaves(cfg if group == "experiment" else {section: cfg[section]}):
        if value is None or path.startswith(FREE) or (path in known and known[path] == value):
            continue
        for wrong in WRONG[type(value)]:
            if wrong is None and path in NULLABLE:
                continue
            found = faults(replaced(cfg, path.split("."), wrong))
            tried += 1
            if not any(path in sentence for sentence in found):
                missed.append((path, wrong))
    assert tried > (500 if word == WHOLE else 5)
    assert not missed, missed


WORDS = [
    *("rl.lr=1e-4", "experiment=smoke", "task.size=[32,32]", "+foo=1", "~rl.lr", "launch=ray", "name=x"),
    *("judge.rewards={progress: 1.0}", "policy._target_=a.b", "++rl.lr=3", "simulator=dit", "seed=3"),
]


@pytest.mark.parametrize("seed", every(4, range(4)))
def test_drawn_overrides_are_understood_or_refused(seed: int) -> None:
    """Whatever is typed is a config or a sentence, never another exception."""
    chance = random.Random(seed)
    for _ in range(8):
        word = list(chance.choice(WORDS))
        for _ in range(chance.randint(1, 3)):
            at = chance.randrange(len(word))
            if chance.random() < 0.4:
                word[at] = ""
            else:
                word.insert(at, chance.choice("[]{}=+~:.,@$'\" \\/x1-_*()&é"))
        with suppress(ConfigError):
            assert load_config(["".join(word)])["name"]


def leaves(section: dict[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Every value and its dotted path; sections are values, too."""
    for key, value in section.items():
        yield f"{prefix}{key}", value
        if isinstance(value, dict):
            yield from leaves(value, f"{prefix}{key}.")


def replaced(section: dict[str, Any], path: list[str], value: Any) -> dict[str, Any]:
    """The config with another value at a path."""
    inner = value if len(path) == 1 else replaced(section[path[0]], path[1:], value)
    return {**section, path[0]: inner}


@pytest.mark.parametrize("name", choices("experiment"))
def test_every_experiment_composes(name: str, tmp_path: Path) -> None:
    cfg = load_config([f"experiment={name}"])
    graph = build_loop(cfg, tmp_path)
    assert ("tokenizer" in graph.nodes) == ("codec" in cfg["simulator"])


def doubled(kind: Any, section: Mapping[str, Any], key: str) -> Iterator[str]:
    """Options of a section that its class has a default for, too; classes of other packages have theirs."""
    parameters = inspect.signature(kind).parameters
    if kind.__module__.split(".")[0] in ("envs", "actors", "learners", "pipeline"):
        for name in section.keys() & parameters.keys():
            if parameters[name].default is not inspect.Parameter.empty:
                yield f"{key}.{name}: {section[name]} here, {parameters[name].default} in {kind.__name__}"
    for name, inner in _within(kind).items():
        if isinstance(section.get(name), Mapping):
            yield from doubled(inner, section[name], f"{key}.{name}")
    for name, value in section.items():
        if isinstance(value, Mapping) and TARGET in value:
            yield from doubled(target(value, key), value, f"{key}.{name}")


@pytest.mark.parametrize(
    "path", sorted(CONFIGS.glob("*/*.yaml")), ids=lambda path: f"{path.parent.name}/{path.stem}"
)
def test_an_option_has_one_default(path: Path) -> None:
    section = yaml.safe_load(path.read_text())
    section = section.get("suite") or section
    if TARGET not in section:
        return
    kind = target(section, path.stem)
    assert not list(doubled(getattr(kind, "config_type", kind), section, path.stem))


@pytest.mark.parametrize("experiment", ["metaworld5", "aloha", "bench4", "roboscape"])
@pytest.mark.parametrize("task", ["metaworld", "aloha", "ogbench"])
def test_what_is_out_of_domain_is_learned_from_in_no_suite(experiment: str, task: str) -> None:
    cfg = read_config([f"experiment={experiment}", f"task={task}"])
    assert cfg["extra_starts"]["variants"] == ["out_of_domain"]
    assert cfg["task"]["suite"]["starts"] == "inner"
    assert cfg["task"]["variants"]["out_of_domain"]["starts"] == "outer"
