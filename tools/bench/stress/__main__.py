"""The command: python -m tools.bench.stress"""

from tools.bench.stress.command import main

if __name__ == "__main__":
    raise SystemExit(main())
