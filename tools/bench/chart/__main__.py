"""The command: python -m tools.bench.chart"""

from tools.bench.chart.bench import ChartBench
from tools.bench.runner import run

if __name__ == "__main__":
    raise SystemExit(run(ChartBench, "tools.bench.chart"))
