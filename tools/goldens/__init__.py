"""Golden files: what each stage makes of its own inputs, and how far that may lie apart on another processor.

Read in this order: kernels, tiny, inputs, measures, golden, chain, spread, mutations, parting.
May import: shared, tools.limn, tools.scoring.

    python -m tools.goldens write [STAGE|chain]  runs each stage from its kept inputs and rewrites its golden file
    python -m tools.goldens spread               the same work under several kernels and thread counts: a table
    python -m tools.goldens mutate [NAME ...]    changes one constant at a time and says which golden files notice
    python -m tools.goldens.parting              where two runs of a stage part, function by function
"""
