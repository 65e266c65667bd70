"""A random order leaves no test out, keeps a file's tests together, and can be had again."""

from types import SimpleNamespace

from random_order import shuffled

ITEMS = [SimpleNamespace(path=path, number=number) for path in "abcdef" for number in range(10)]


def test_every_test_once_in_another_order():
    order = shuffled(ITEMS, 1)
    assert order != ITEMS and sorted(map(id, order)) == sorted(map(id, ITEMS))
    assert [item.number for item in order if item.path == "a"] != list(range(10))


def test_tests_of_a_file_stay_together():
    paths = [item.path for item in shuffled(ITEMS, 1)]
    assert sum(before != after for before, after in zip(paths, paths[1:], strict=False)) == 5
    assert list(dict.fromkeys(paths)) != list("abcdef")


def test_the_seed_gives_the_order():
    assert shuffled(ITEMS, 1) == shuffled(ITEMS, 1) != shuffled(ITEMS, 2)
