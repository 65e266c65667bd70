"""Score a result against a subject whose truth is known: python -m tools.score SUBJECT [EXPORT]"""

from tools.scoring.score import main

if __name__ == "__main__":
    raise SystemExit(main())
