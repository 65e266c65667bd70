"""How the processor is used: compiled loops, threads, reading ahead, and what makes results the same on
all processors.

Read in this order: kept_code, compiled, processor, threads, parallel, run_context, read_ahead, robust,
smooth_step, sparse_solve.
May import: nothing.
"""
