"""The command line: python -m tools.goldens write | spread | mutate (see the package's own words)."""

from __future__ import annotations

import argparse

import tools.goldens
from tools.goldens.chain import write_chain
from tools.goldens.golden import write
from tools.goldens.kernels import WAYS, by_name
from tools.goldens.mutations import MUTATIONS, mutation_table
from tools.goldens.spread import chain_table, spread_table
from tools.goldens.tiny import STAGES

CHAIN = "chain"


def main() -> int:
    """Does what the words say."""
    parser = argparse.ArgumentParser(description=tools.goldens.__doc__,
                                     formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("action", choices=("write", "spread", "mutate"))
    parser.add_argument("names", nargs="*", help="stages, of write also chain; of mutate: mutations; all by default")
    parser.add_argument("--ways", nargs="*", default=[way.name for way in WAYS], help="of spread: which ways to run")
    parser.add_argument("--chain", action="store_true", help="of spread: each stage reads what the ones before it made")
    parser.add_argument("--at-once", type=int, default=2, metavar="N", help="stages that run side by side")
    args = parser.parse_args()
    if args.action == "write":
        write([name for name in args.names if name != CHAIN] or (STAGES if not args.names else ()), args.at_once)
        if not args.names or CHAIN in args.names:
            write_chain()
    elif args.action == "spread":
        ways = [by_name(name) for name in args.ways]
        print(chain_table(ways) if args.chain else spread_table(args.names or STAGES, ways, args.at_once))
    else:
        chosen = [m for m in MUTATIONS if not args.names or m.name in args.names]
        print(mutation_table(chosen, args.at_once))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
