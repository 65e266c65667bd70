"""The command: python -m tools.bench.chart"""

from tools.bench.chart.command import main

if __name__ == "__main__":
    raise SystemExit(main())
