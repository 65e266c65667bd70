"""The command: python -m tools.relight"""

from tools.relight.command import main

if __name__ == "__main__":
    raise SystemExit(main())
