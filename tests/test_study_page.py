"""The study's page: which figure stands where, what is divided by what, and that the paper's figures are the paper's."""

import re

import pytest
from study_reports import CELL, report_of

from lbsfit_np.bench.study.data import SIZES
from lbsfit_np.bench.study.page import console_table, page
from lbsfit_np.bench.study.paper import PAPER
from lbsfit_np.bench.study.rows import ROWS

GAP = {"before": 0.20, "after": 0.05, "before, up to a shift": 0.10, "after, up to a shift": 0.04}
TESTED = {"before": 0.30, "after": 0.06, "before, up to a shift": 0.15, "after, up to a shift": 0.07}


def _table(report, title):
    """Lines of cells of the table of the page under a heading."""
    section = re.split(r"^#+ ", page(report, {}), flags=re.MULTILINE)
    (text,) = [part for part in section if part.startswith(title + "\n")]
    return [[c.strip() for c in line[1:-1].split("|")] for line in text.splitlines() if line.startswith("|")]


def _columns(report, row, title="Registrations"):
    """[(head, entry)] of a row of a table."""
    heads, _, *lines = _table(report, title)
    (entries,) = [line[1:] for line in lines if line[0] == row]
    return list(zip(heads[1:], entries, strict=True))


def test_columns_are_explained_at_the_first_table_that_has_them():
    learned = {"accuracy": [0.8, 0.9], "kept_accuracy": 0.9, "kept_accuracy_scans": [0.9], "history": _history(1, 1)}
    learned |= {"gap": {"subjects": GAP}}
    first, second = report_of("body", oracle_fit={}), report_of("hand", joint=learned, rand=learned, cd={})
    both = first | {"rigs": first["rigs"] | second["rigs"]}
    text = page(both, {})
    assert "### Labels" not in text[: text.index("## Hand")]
    for words in ("The share of the test scans' points", "**before** is ‖U − U^gt‖", "≈ stands between rows", "**Recon**: √L_c"):
        assert page(second, {}).count(words) == text.count(words) == 1


def test_an_order_says_which_rows_lack_scans():
    report = report_of(joint={}, rand=[{"unfitted": 2}, {"unfitted": 1}], cd={})
    assert " Without scans that could not be fitted: rand 2." in page(report, {})
    assert "Without scans" not in page(report_of(joint={}, rand={}, cd={}), {})
    known = {"kept_accuracy": 0.9, "unfitted": 2}  # the segmenter labels all scans
    lines = [line for line in page(report_of(joint=known, rand=known), {}).splitlines() if ". Joint before rand" in line]
    assert len(lines) == 4 and ["Without scans" in line for line in lines] == [True, True, True, False]


def test_where_the_structured_distance_does_not_fall_all_the_way_the_page_says_so():
    path = {"chain": "c", "from": "a", "to": "b", "rise": 1.5, "chamfer": [1.0, 1.5, 0.1], "structured_rise": 1.0}
    for curve, words in (([1.0, 0.5, 0.1], "L_s falls."), ([1.0, 0.3, 0.9], "L_s never rises above 1.00 times its own.")):
        report = report_of(joint={})
        report["rigs"]["hand"]["local_optimum"] = path | {"structured": curve}
        assert f"before it falls; {words}" in page(report, {})


def _goals(report):
    """{what: (found, goal, reached)}."""
    return {what: tuple(rest) for what, *rest in _table(report, "Goals")[2:]}


def _history(kept, n):
    return [{"round": k, "kept": k == kept} for k in range(n + 1)]


# ---- the main table ----


def test_every_figure_stands_under_its_name():
    paper = [f"[{value:.3f}]" for value in PAPER["hand"]["joint"]]
    assert _columns(report_of(joint={}), "joint") == [
        ("Recon", f"0.0420 {paper[0]}"),
        ("at the truth", "0.0400"),
        ("÷", "1.05"),
        ("Pose", f"0.0110 {paper[1]}"),
        ("median", "0.0120"),
        ("vertices", "0.0140"),
        ("unfitted", "0"),
        ("s", "77"),
    ]
    assert _columns(report_of(joint={}), "joint", "Correspondences") == [
        ("Corre.", f"0.0210 {paper[2]}"),
        ("p50", "0.0220"),
        ("p90", "0.0230"),
        ("p95", "0.0240"),
        ("snapped", f"0.0310 {paper[2]}"),
        ("snapped p50", "0.0320"),
        ("snapped p90", "0.0330"),
        ("snapped p95", "0.0340"),
    ]


def test_seeds_have_a_mean_and_a_range_and_what_was_not_fitted_is_counted():
    columns = dict(_columns(report_of(cd=[{"pose": 0.1, "unfitted": 1}, {"pose": 0.2, "unfitted": 2}]), "cd"))
    assert columns["Pose"].startswith("0.1500 (0.1000–0.2000)") and columns["unfitted"] == "3"


def test_the_papers_figures_are_those_of_its_table():
    """Table 1 of the paper; and of its text, three times the data."""
    rows = ("free-form", "free-form-augmented", "free-form-supervised", "cd", "rand", "joint")
    bodies = """
        0.076 0.082 0.136
        0.081 0.081 0.132
        0.073 0.071 0.104
        0.051 0.152 0.147
        0.041 0.058 0.100
        0.037 0.048 0.091
    """
    hands = """
        0.099 0.035 0.176
        0.069 0.049 0.140
        0.062 0.047 0.135
        0.082 0.069 0.168
        0.069 0.050 0.137
        0.053 0.035 0.111
    """
    for kind, table in (("body", bodies), ("hand", hands)):
        figures = [tuple(map(float, line.split())) for line in table.strip().splitlines()]
        assert {row: PAPER[kind][row] for row in rows} == dict(zip(rows, figures, strict=True)), kind
    assert set(PAPER["hand"]) == set(rows)
    assert PAPER["body"].keys() - set(rows) == {"free-form-supervised-3x"}
    assert PAPER["body"]["free-form-supervised-3x"] == (None, None, 0.095)


@pytest.mark.parametrize("kind", ["hand", "body"])
def test_each_row_has_the_papers_figures_of_its_kind(kind):
    report = report_of(kind, **{row.replace("-", "_"): {} for row in ROWS})
    for row in ROWS:
        columns = dict(_columns(report, row) + _columns(report, row, "Correspondences"))
        said = [re.findall(r"\[(.*)\]", columns[name]) for name in ("Recon", "Pose", "Corre.", "snapped")]
        known = PAPER[kind].get(row, (None,) * 3)
        assert said == [[] if value is None else [f"{value:.3f}"] for value in (*known, known[2])], row


def test_on_the_training_scans_the_papers_figures_are_those_of_bodies():
    trained = {"on_training": CELL | {"corre": {"mean": 0.055}, "pose": 0.066}}
    text = page(report_of("body", joint=trained, free_form_supervised=trained), {})
    assert "On the training scans, joint: Corre. 0.0550 [0.069], Pose 0.0660" in text
    assert "On the training scans, free-form-supervised: Corre. 0.0550 [0.065], Pose 0.0660" in text
    assert "On the training scans, joint: Corre. 0.0550, Pose 0.0660" in page(report_of(joint=trained), {})


# ---- what is said below it ----


LEARNED = "template gap of the people learned from, ÷ before (the paper's bodies: 0.67)"
OTHERS = "template gap of the test scans, each a template of its own, ÷ before"


def test_gaps_of_templates_are_after_over_before():
    report = report_of(joint={"gap": {"subjects": GAP, "test scans": TESTED}})
    goals = _goals(report)
    assert goals[LEARNED] == ("0.25", "≤ 0.5", "yes") and goals["the same up to a shift"] == ("0.40", "≤ 0.5", "yes")
    assert goals[OTHERS] == ("0.20", "≤ 0.5", "yes")
    heads, _, learned, tested = _table(report, "Templates")
    assert heads[2:] == ["before", "after", "÷", "before, up to a shift", "after", "÷"]
    assert learned == ["joint", "people learned from", "0.2000", "0.0500", "0.25", "0.1000", "0.0400", "0.40"]
    assert tested == ["joint", "test scans", "0.3000", "0.0600", "0.20", "0.1500", "0.0700", "0.47"]


def test_shares_of_gaps_are_means_over_the_seeds():
    other = TESTED | {"before": 0.6, "after": 0.3}
    seeds = [{"gap": {"subjects": GAP, "test scans": gap}} for gap in (TESTED, other)]
    assert _goals(report_of(joint=seeds))[OTHERS] == ("0.35 (0.20–0.50)", "≤ 0.5", "yes")  # not 0.18 ÷ 0.45


def test_a_gap_that_grew_misses_its_goal():
    grown = GAP | {"before": 0.05, "after": 0.2}
    assert _goals(report_of(joint={"gap": {"subjects": grown}}))[LEARNED] == ("4.00", "≤ 0.5", "no")
    grown = {"subjects": GAP, "test scans": TESTED | {"after": 0.16}}
    assert _goals(report_of(joint={"gap": grown}))[OTHERS] == ("0.53", "≤ 0.5", "no")


@pytest.mark.parametrize("n, words", [(1, "The goals are for 3 seeds; here is one."), (2, "here are 2."), (3, None)])
def test_goals_of_fewer_seeds_are_said_to_be(n, words):
    for text in (page(report_of(joint=[{}] * n), {}), console_table(report_of(joint=[{}] * n))):
        assert (words or "The goals are for") in text if words else "The goals are for" not in text


def test_seeds_of_goals_are_those_that_joint_was_run_of():
    assert "The goals are for 3 seeds; here is one." in page(report_of(joint={}, rand=[{}, {}, {}]), {})


def test_joint_is_divided_by_the_oracle():
    half = {"recon": 0.021, "pose": 0.0055 / 2, "vertices": 0.007, "corre": CELL["corre"] | {"mean": 0.042}}
    text = page(report_of(joint={}, oracle_fit=half), {})
    assert "Joint ÷ oracle fit: Recon 2.00, Pose 4.00, Corre. 0.50, vertices 2.00." in text


def test_recon_is_divided_by_its_value_at_the_truth_seed_by_seed():
    cells = [{"recon": 0.06, "recon_truth": 0.03}, {"recon": 0.04, "recon_truth": 0.04}]
    assert _goals(report_of(joint=cells))["Recon ÷ its value at the truth"] == ("1.50 (1.00–2.00)", "≤ 1.05", "no")


def test_recon_below_that_of_the_truth_is_no_better():
    recon = {"joint": 0.045, "rand": 0.03, "cd": 0.06}
    report = report_of(**{row: {"recon": value, "recon_truth": 0.04} for row, value in recon.items()})
    line = "Recon ÷ its value at the truth, 1 where it is less: rand 1.00 < joint 1.12 < cd 1.50"
    assert f"{line}. Joint before rand before cd: missed." in console_table(report)
    report = report_of(**{row: {"recon": value, "recon_truth": 0.05} for row, value in recon.items()})
    assert "≈ rand 1.00 < cd 1.20. Joint before rand before cd: level" in console_table(report)


def test_accuracies_are_before_learning_and_of_what_was_kept():
    learned = {"accuracy": [0.80, 0.90, 0.93], "kept_accuracy": 0.91, "fitted_labels": 0.97, "history": _history(1, 2)}
    learned["kept_accuracy_scans"] = [0.95, 0.4, None]
    other = {"accuracy": [0.80, 0.85], "kept_accuracy": 0.82, "fitted_labels": None, "history": _history(1, 1)}
    report = report_of(joint=learned, rand=learned | other, cd={})
    heads, _, *lines = _table(report, "Labels")
    assert heads == ["", "before learning", "as kept", "single scans", "round kept", "labels of its fits"]
    assert lines == [
        ["rand", "80.0%", "82.0%", "40% to 95%", "1 of 1", "–"],
        ["joint", "80.0%", "91.0%", "40% to 95%", "1 of 2", "97.0%"],
    ]
    assert _goals(report)["labels of the segmenter alone"] == ("0.910", "≥ 0.95", "no")
    of_bodies = _goals(report_of("body", joint=learned | {"kept_accuracy": 0.96}))
    assert of_bodies["labels of the segmenter alone"] == ("0.960", "≥ 0.96", "yes")


def test_seeds_that_kept_different_rounds_are_named():
    learned = {"accuracy": [0.80, 0.90, 0.90], "kept_accuracy": 0.90, "kept_accuracy_scans": [0.9]}
    report = report_of(joint=[learned | {"history": _history(1, 2)}, learned | {"history": _history(2, 2)}])
    assert dict(_columns(report, "joint", "Labels"))["round kept"] == "1 of 2, 2 of 2"


def test_the_floor_of_pose_is_that_of_the_true_template():
    assert re.search(r"- Pose of the exact template in the exact pose.*: 0\.0130\.", page(report_of(joint={}), {}))


VERDICTS = [(0.02, "kept"), (0.001, "missed"), (0.2, "missed"), (0.0102, "level"), (0.0098, "level")]
VERDICTS += [(0.0104, "kept"), (0.0096, "missed")]


@pytest.mark.parametrize("rand, verdict", VERDICTS)
def test_the_order_of_the_ablations_is_from_the_least_error(rand, verdict):
    poses = {"joint": 0.01, "rand": rand, "cd": 0.1}
    text = console_table(report_of(**{row: {"pose": pose, "pose_median": pose} for row, pose in poses.items()}))
    (line,) = [line for line in text.splitlines() if line.startswith("- Pose: ")]
    ranked = [row for row, _ in sorted({"joint": 0.01, "rand": rand, "cd": 0.1}.items(), key=lambda known: known[1])]
    assert re.findall(r"(joint|rand|cd) \d", line) == ranked and line.endswith(f": {verdict}.")
    assert ("≈" in line) == (verdict == "level")


def test_an_order_of_few_scans_is_said_to_be_one():
    report = report_of(joint={"pose": 0.01, "pose_median": 0.01}, rand={"pose": 0.02, "pose_median": 0.02})
    assert "Joint before rand: kept." in console_table(report)
    report["rigs"]["hand"]["size"]["test"] = 19
    assert "Joint before rand: kept, of 19 scans, which are few." in console_table(report)
    both = report_of(joint=[{"pose": 0.01, "pose_median": 0.01}] * 2, rand=[{"pose": 0.02, "pose_median": 0.02}] * 2)
    both["rigs"]["hand"]["size"]["test"] = 10
    assert "Joint before rand: kept." in console_table(both)


def test_an_order_that_the_medians_do_not_have_is_said_to_be_of_the_means():
    for mean, middle, verdict in (
        (0.02, 0.012, "kept"),
        (0.02, 0.0102, "kept by the means, level by the medians"),
        (0.02, 0.009, "kept by the means, missed by the medians"),
        (0.008, 0.02, "missed by the means, kept by the medians"),
        (0.0101, 0.02, "level by the means, kept by the medians"),
        (0.008, 0.009, "missed"),
    ):
        report = report_of(joint={"pose": 0.01, "pose_median": 0.01}, rand={"pose": mean, "pose_median": middle})
        assert f"Joint before rand: {verdict}." in console_table(report)
    corre = [{"mean": mean, "p50": 0.01, "p90": mean, "p95": mean} for mean in (0.01, 0.02)]
    text = console_table(report_of(joint={"corre": corre[0]}, rand={"corre": corre[1]}))
    assert "- Corre.: joint 0.0100 < rand 0.0200. Joint before rand: kept by the means, level by the medians." in text


def test_labels_have_an_order_too():
    right = {"joint": 0.8, "rand": 0.82}
    told = {row: {"accuracy": [0.7, kept], "kept_accuracy": kept, "history": _history(1, 1)} for row, kept in right.items()}
    text = console_table(report_of(**told, cd={}))
    assert "- Label errors of the segmenter alone: rand 0.1800 < joint 0.2000. Joint before rand: missed." in text


def test_what_does_not_hold_for_a_rig_is_said():
    other, hand = report_of(kind="other", joint={}), report_of(joint={})
    assert "other: by its joints' names neither a hand nor a body" in page(other, {}) and "neither a hand" not in page(hand, {})
    for library, said in (({"train": 3, "test": 1}, False), ({"train": 0, "test": 0}, True)):
        hand["rigs"]["hand"]["library"] = library
        assert ("hand: its rig has no library of natural poses to divide, so all poses are uniform" in page(hand, {})) == said


def test_scans_without_a_fit_are_told_beside_the_goals():
    for unfitted, words in ((0, ""), (1, "Without 1 scan that"), (5, "Without 5 scans that could not be fitted.")):
        text = page(report_of(joint={"unfitted": unfitted}), {})
        goals = text.split("### Goals")[1].split("###")[0]
        assert words in goals and ("could not be fitted" in goals) == bool(unfitted)


@pytest.mark.parametrize("pose, reached", [(0.012, ("yes", "yes")), (0.0121, ("yes", "no")), (0.021, ("no", "no"))])
def test_pose_has_a_goal_and_an_aim(pose, reached):
    goals = _goals(report_of(joint={"pose": pose}))
    assert [goals[what] for what in ("Pose", "Pose, aim beyond the goal")] == [
        (f"{pose:.4f}", f"≤ {bound:g}", met) for bound, met in zip((0.02, 0.012), reached, strict=True)
    ]


def test_pictures_stand_in_reading_order_whatever_order_they_come_in():
    captions = {name: f"Of {name}." for name in ("accuracy.png", "diagram.png", "triplet-hand.png", "triplet-body.png", "a.png")}
    found = re.findall(r"!\[(.*?)\]", page(report_of(joint={}), captions))
    assert found == ["diagram", "triplet body", "triplet hand", "accuracy", "a"]


def test_what_was_not_run_leaves_no_gap_in_the_console():
    assert "\n\n\n" not in console_table(report_of(oracle_fit={}))


def test_rows_that_lack_seeds_are_named_in_the_console_as_on_the_page():
    report = report_of(joint=[{}, {}, {}], cd=[{}], rand=[{}, {}])
    words = "Fewer seeds: hand, cd: 300 alone; hand, rand: 300, 301."
    assert console_table(report).endswith(f"\n\n{words}") and console_table(report, markdown=True).endswith(words)
    assert f"{words} Lengths are in half sizes" in page(report, {})
    assert "Fewer seeds" not in console_table(report_of(joint=[{}, {}], rand=[{}, {}]))


@pytest.mark.parametrize("n, words", [(1, "seed 300;"), (2, "seeds 300, 301;")])
def test_one_seed_is_a_seed(n, words):
    text = page(report_of(joint=[{}] * n), {})
    assert words in text and ("with their range" in text) == (n > 1)


@pytest.mark.parametrize("size", SIZES)
def test_the_papers_size_is_pointed_to_from_the_others(size):
    text = page(report_of(joint={}) | {"size": size}, {})
    end = "." if size == "paper" else ", as `--size paper` does."
    words = f'- Size "{size}": the paper learns from 1,500 hands and 23,000 bodies and tests on 300 and 2,300{end}\n'
    assert words in text


def test_all_columns_are_explained():
    """Where they first stand, once."""
    learned = {"accuracy": [0.8, 0.9], "kept_accuracy": 0.9, "kept_accuracy_scans": [0.9], "history": _history(1, 1)}
    report = report_of(joint=learned | {"gap": {"subjects": GAP}})
    report["rigs"]["body"] = report["rigs"]["hand"]
    text = page(report, {})
    for title in ("Registrations", "Correspondences", "Labels", "Templates"):
        first, second = re.findall(rf"^### {title}\n(.*?)^\|(.*?)$", text, flags=re.MULTILINE | re.DOTALL)
        assert first[1] == second[1] and not second[0].strip()
        for head in first[1].strip("| ").split(" | "):
            told = f"**{head}**" in first[0] or (re.match(r"(snapped )?p\d\d", head) and "percentiles" in first[0])
            assert told or (head == "before, up to a shift" and "up to a shift" in first[0]), head


def test_rows_are_ranked_over_the_seeds_in_which_all_have_the_measure():
    """Over both seeds joint would be 0.0550, and behind rand; cd never has it and keeps nobody out."""
    none = {"corre": None}
    rows = {"joint": [{"corre": {"mean": 0.01}}, none], "rand": [{"corre": {"mean": 0.02}}, {"corre": {"mean": 0.001}}]}
    text = console_table(report_of(**rows, cd=[none, none]))
    assert "- Corre.: joint 0.0100 < rand 0.0200. Joint before rand: kept." in text
    apart = console_table(report_of(joint=[{"corre": {"mean": 0.01}}, none], rand=[none, {"corre": {"mean": 0.02}}]))
    assert "- Corre.: " not in apart and "- Pose: " in apart


def test_joint_is_divided_by_the_oracle_of_the_same_seeds():
    joint = [{"corre": {"mean": 0.02}}, {"corre": None, "pose": 0.03}]
    oracle = [{"corre": {"mean": 0.01}, "pose": 0.01}, {"corre": {"mean": 0.05}, "pose": 0.01}]
    text = page(report_of(joint=joint, oracle_fit=oracle), {})
    assert "Joint ÷ oracle fit: Recon 1.00, Pose 2.05, Corre. 2.00, vertices 1.00." in text


def test_nothing_is_divided_by_an_oracle_without_errors():
    text = page(report_of(joint={}, oracle_fit={"pose": 0.0}), {})
    assert "Joint ÷ oracle fit: Recon 1.00, Corre. 1.00, vertices 1.00." in text


def test_what_segmenters_began_with_is_said():
    report = report_of(joint={})
    assert "; 200 synthetic scans for the segmenter before learning and as many in each round\n" in page(report, {})
    report["rigs"]["hand"]["first_scans"] = 4000
    said = "; 4,000 synthetic scans for the segmenter before learning (it comes with the package), 200 in each round\n"
    assert said in page(report, {})
