"""The command: python -m tools.bench.stress"""

from tools.bench.runner import run
from tools.bench.stress.bench import StressBench

if __name__ == "__main__":
    raise SystemExit(run(StressBench, "tools.bench.stress"))
