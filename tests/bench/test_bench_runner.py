"""The runner of all benches: what is measured, what is kept, what goes on; with a toy bench that counts."""

import csv
import sys
import time

import numpy as np
import pytest

from shared.errors import InputError
from shared.io.arrays import read_json
from tools.bench.__main__ import BENCHES, main
from tools.bench.runner import Bench, Clock, Table, markdown_table, measured, run


class ToyBench(Bench):
    """Squares of numbers; three cannot be measured."""

    name, columns, calls = "toy", ("case", "square"), []

    @classmethod
    def add_arguments(cls, parser):
        parser.add_argument("--scale", type=float, default=1.0)

    def facts(self):
        return {"scale": self.options.scale, "of": (1, 2)}

    def cases(self):
        return {"one": 1, "two": 2, "three": 3, "twenty": 20}

    def measure(self, case, entry):
        self.calls.append((entry.repeat, entry.name))
        if case == 3 and "three may pass" not in self.calls:
            raise InputError("no threes", where="toy")
        entry.add({"square": np.float64(self.options.scale * case**2), "odd": np.bool_(case % 2), "root": np.nan})


@pytest.fixture
def toy(tmp_path):
    ToyBench.calls.clear()
    return lambda *words: run(ToyBench, "toy", ["--out", str(tmp_path), *words])


def rows_of(folder):
    return read_json(folder / "toy.json")["rows"]


def test_a_case_that_fails_does_not_stop_the_others_and_is_tried_again(toy, tmp_path):
    assert toy() == 1
    assert [row["case"] for row in rows_of(tmp_path)] == ["one", "two", "twenty"]
    ToyBench.calls[:] = ["three may pass"]
    assert toy() == 0 and ToyBench.calls[1:] == [(0, "three")]
    assert [row["square"] for row in rows_of(tmp_path)] == [1.0, 4.0, 400.0, 9.0]


def test_all_cases_are_measured_before_any_is_again(toy, tmp_path):
    assert toy("--only", "one", "two", "--repeats", "2") == 0
    assert ToyBench.calls == [(0, "one"), (0, "two"), (1, "one"), (1, "two")]
    assert toy("--only", "one", "--repeats", "3") == 0 and ToyBench.calls[4:] == [(2, "one")]
    assert len(rows_of(tmp_path)) == 5


def test_words_choose_cases_by_name_or_by_a_part_of_it(toy):
    assert toy("--only", "tw") == 0 and ToyBench.calls == [(0, "two"), (0, "twenty")]
    assert toy("--only", "four") == 2 and len(ToyBench.calls) == 2


def test_rows_of_other_facts_are_measured_anew_and_the_old_ones_kept(toy, tmp_path):
    toy("--only", "two")
    toy("--only", "two", "--scale", "2")
    assert [row["square"] for row in rows_of(tmp_path)] == [8.0]
    assert read_json(tmp_path / "toy.old.json")["rows"][0]["square"] == 4.0
    assert Table.open(tmp_path / "toy.json", {"scale": 2.0, "of": [1, 2]}).of("two")[0]["odd"] is False


def test_nothing_begins_when_the_minutes_are_over_nor_for_a_list_or_a_table(toy, tmp_path):
    assert toy("--minutes", "-1") == toy("--list") == toy("--table") == 0
    assert ToyBench.calls == [] and not list(tmp_path.iterdir())


def test_the_table_is_there_for_people_too(toy, tmp_path):
    toy("--only", "two")
    with open(tmp_path / "toy.csv", encoding="utf-8") as file:
        assert list(csv.DictReader(file)) == [{"case": "two", "square": "4.0"}]
    assert (tmp_path / "toy.md").read_text() == "| case | square |\n| --- | --- |\n| two | 4 |\n"
    assert rows_of(tmp_path)[0]["root"] is None
    assert markdown_table([{"a": 1.23456, "case": "x|y"}]).splitlines()[-1] == "| x/y | 1.235 |"


def test_a_clock_stands_still_while_it_is_told_to():
    began, clock = time.perf_counter(), Clock()
    with clock:
        stopped = clock.wall_s
        time.sleep(0.1)
        assert clock.wall_s == stopped
    assert stopped <= clock.wall_s <= time.perf_counter() - began - 0.09 and clock.cpu_s >= 0.0


def test_a_process_is_measured(tmp_path):
    work = "import time; t = time.process_time()\nwhile time.process_time() < t + 0.3: pass"
    cost = measured([sys.executable, "-c", f"{work}\ntime.sleep(0.3)"], tmp_path / "log")
    assert cost["wall_s"] > 0.55 and 0.28 < cost["cpu_s"] < cost["wall_s"] and cost["others"] >= 0.0
    with pytest.raises(InputError, match="the last word.*exit code 3"):
        measured([sys.executable, "-c", "print('the last word'); raise SystemExit(3)"], tmp_path / "log")


@pytest.mark.parametrize("name", [name for name in BENCHES if name != "shading"])
def test_every_bench_is_found_and_explains_itself(name):
    with pytest.raises(SystemExit) as ended:
        main([name, "--help"])
    assert ended.value.code == 0


def test_a_bench_that_is_not_there_is_refused():
    assert main(["poetry"]) == main([]) == 2
