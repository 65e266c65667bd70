"""Make a head-turn clip whose every truth is known: python -m tools.synthesize DEST"""

from tools.synthesis.subject import main

if __name__ == "__main__":
    raise SystemExit(main())
