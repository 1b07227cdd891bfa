"""`caneflow experiments`: the page says what the evaluations say, beside the paper, and is the same every time."""

import re
from pathlib import Path

import numpy as np
import pytest
from typer import Exit

from caneflow.algorithms.judging.track_errors import Track
from caneflow.errors import CaneflowError
from caneflow.runtime.replays.evaluation import FIGURES, Evaluation
from caneflow.simulation.scenario import SCENARIOS
from tools import experiments, simulate

FLOW = Path(__file__).parents[1] / "dataflow.yaml"


def figures(error: float | None, nees: float | None = None) -> dict[str, float | None]:
    known: dict[str, float | None] = dict.fromkeys(FIGURES)
    return known | {"duration": 50.0, "final_distance": error, "final_error": error, "nees": nees}


def circle(radius: float) -> Track:
    angle = np.linspace(0.0, 2.0 * np.pi, 200)
    nothing = np.zeros(200)
    return Track(
        stamps=10_000_000 * np.arange(200, dtype=np.int64),
        positions=np.column_stack([radius * np.sin(angle), radius * (1.0 - np.cos(angle)), nothing]),
        orientations=np.tile([1.0, 0.0, 0.0, 0.0], (200, 1)),
    )


def ten(scenario: str) -> list[Evaluation]:
    """Ten walks: the Luenberger errs by 1 .. 10 m, the naive INS by a hundred times that."""
    return [
        Evaluation(
            recording=Path(f"{scenario}_{seed}.mcap"),
            figures={"luenberger": figures(float(seed)), "naive_ins": figures(100.0 * seed)},
            tracks={"luenberger": circle(1.0 + 0.1 * seed)},
            truth=circle(1.0),
        )
        for seed in range(1, 11)
    ]


METHODS = ("luenberger", "naive_ins")


def page(results: dict[str, list[Evaluation]]) -> str:
    return "\n".join(experiments.page(results, METHODS, {}))


def rows(text: str, first: str) -> list[list[str]]:
    """The cells of the table rows whose first cell is `first`."""
    table = [line.strip("| ").split(" | ") for line in text.splitlines() if line.startswith("|")]
    return [cells for cells in table if cells[0] == first]


def test_every_scenario_of_the_simulator_is_an_experiment() -> None:
    assert set(experiments.EXPERIMENTS) == set(SCENARIOS)


def test_table_one_has_the_papers_figures_above_ours() -> None:
    text = page({"swing": ten("swing")})
    paper = text.splitlines().index("| Luenberger | paper | 2.7 | 0.5 | 1.3 | 0.026 |")
    # 1 .. 10: mean 5.5, variance 55 / 6 with n - 1, over 50 s
    assert text.splitlines()[paper + 1] == "|  | here | 10.00 | 3.03 | 5.50 | 0.110 |"
    assert "| naive INS | paper | 246 | 74 | 132 | 2.64 |" in text


def test_a_scenario_that_is_not_the_papers_has_no_table_one() -> None:
    assert "Table I\n" not in page({"stops": ten("stops")})


def test_the_papers_error_is_not_given_for_an_open_path() -> None:
    closed, opened = (rows(page({name: ten(name)}), "Luenberger")[-1] for name in ("stops", "straight"))
    assert (closed[1], opened[1]) == ("5.50", "")
    assert closed[2:] == opened[2:]


def test_every_walk_has_its_figure() -> None:
    (walks,) = rows(page({"slow": ten("slow")}), "`slow`")
    assert walks[1:] == ["Luenberger", *(f"{seed}.00" for seed in range(1, 11))]


def test_a_walk_that_failed_is_named_and_the_others_count() -> None:
    evaluations = ten("hard")
    evaluations[9] = Evaluation(recording=Path("hard_10.mcap"), failures={"luenberger": "no orientation"})
    text = page({"hard": evaluations})
    assert "**Luenberger failed on hard_10**: no orientation" in text
    assert rows(text, "Luenberger")[0][2] == "5.00"  # the mean of 1 .. 9
    assert rows(text, "`hard`")[0][-1] == "-"


def test_pictures_are_small_and_the_same_every_time(tmp_path: Path) -> None:
    pyplot = experiments._pyplot()
    results = {"swing": ten("swing"), "stops": ten("stops")}
    paths = {name: tmp_path / f"results_{name}.png" for name in ("tracks", "errors")}
    links = experiments.draw(pyplot, results, METHODS, paths)
    first = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    linked = [re.findall(r"\(pictures/(.*)\)", link) for link in links.values()]
    assert sorted(first) == sorted(name for names in linked for name in names)
    assert all(len(data) < 200_000 for data in first.values())
    experiments.draw(pyplot, results, METHODS, paths)
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == first


def test_the_fingerprint_is_of_what_the_code_does(tmp_path: Path) -> None:
    walks = tmp_path / "walks.py"
    walks.write_text("from here.steps import f\nfrom here import shoes\n")
    (tmp_path / "shoes.py").write_text("from here.walks import f\n")

    def of(text: str) -> str:
        (tmp_path / "steps.py").write_text(text)
        return experiments.fingerprint(walks)

    plain = of("def f(x):\n    return x + 1\n")
    assert of('"""A step."""\n\ndef f(x):\n    """One more."""\n    return (x + 1)  # why\n') == plain
    assert of("def f(x):\n    return x + 2\n") != plain
    (tmp_path / "rooms.py").write_text("nothing = 'to do with walks'\n")
    assert of("def f(x):\n    return x + 1\n") == plain
    (tmp_path / "shoes.py").write_text("size = 42\n")
    assert of("def f(x):\n    return x + 1\n") != plain


def test_a_walk_that_cannot_be_simulated_is_an_error_that_says_why(tmp_path: Path) -> None:
    with pytest.raises(CaneflowError, match=r"--scenario swim --seed 1 .*no walk 'swim'"):
        experiments.simulate([tmp_path / "swim_1.mcap"], 1)
    assert list(tmp_path.iterdir()) == []


def test_an_experiment_that_is_not_there_is_an_error() -> None:
    with pytest.raises(CaneflowError, match="--only swim: no such experiment; there are swing, "):
        experiments.command(only="swim")


def test_the_command_writes_the_same_page_again(tmp_path: Path) -> None:
    """On a walk of 4 s in the place of the whole one."""
    walk = tmp_path / "walks" / experiments.fingerprint() / "swing_1.mcap"
    walk.parent.mkdir(parents=True)
    simulate.walk(output=walk, scenario="swing", seed=1, duration=4.0)

    def written(name: str) -> tuple[str, bytes]:
        output = tmp_path / name / "results.md"
        output.parent.mkdir()
        experiments.command(output=output, seeds=1, only="swing", flow=FLOW, folder=tmp_path / "walks")
        return output.read_text(), (output.parent / "pictures" / "results_errors.png").read_bytes()

    first = written("first")
    assert written("second") == first
    assert "Scenario `swing`, 1 x 4 s on average" in first[0]
    assert list(walk.parent.iterdir()) == [walk]


def test_a_broken_walk_ends_the_command_with_status_1(tmp_path: Path) -> None:
    walk = tmp_path / "walks" / experiments.fingerprint() / "swing_1.mcap"
    walk.parent.mkdir(parents=True)
    walk.write_text("cut")
    with pytest.raises(Exit) as ended:
        experiments.command(output=tmp_path / "results.md", seeds=1, only="swing", flow=FLOW, folder=tmp_path / "walks")
    assert ended.value.exit_code == 1
    assert "**Luenberger failed on swing_1**" in (tmp_path / "results.md").read_text()
