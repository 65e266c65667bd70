"""pytest --order-seed N: the test files, and the tests within each, in an order drawn with the seed N.

A file's tests stay together: what its fixtures hold is built once.
"""

import random


def pytest_addoption(parser):
    parser.addoption("--order-seed", type=int, metavar="N", help="run the tests in the random order number N")


def pytest_report_header(config):
    seed = config.getoption("--order-seed")
    return None if seed is None else f"random order: --order-seed {seed}"


def pytest_collection_modifyitems(config, items):
    seed = config.getoption("--order-seed")
    if seed is not None:
        items[:] = shuffled(items, seed)


def shuffled(items: list, seed: int) -> list:
    """The items, each with a `path`, in random order; those of one path follow each other."""
    chance = random.Random(seed)
    files = {}
    for item in items:
        files.setdefault(item.path, []).append(item)
    groups = list(files.values())
    chance.shuffle(groups)
    for group in groups:
        chance.shuffle(group)
    return [item for group in groups for item in group]
