"""Measurements for developers: python -m tools.bench NAME --help; without a NAME, their names.

Read in this order: runner, drawing, clips, shape, model_selection, whole_choice, level, published, tracking, whole_run,
hard_light, rerender, real_page, real, colour_chart, statue, shading, phases, sampler, machine_limits, budget, marked,
profile, growth, schedule, throughput.
May import: shared, stages, tools.synthesis, tools.scoring, tools.bench.runner, tools.bench.drawing, tools.bench.peers,
tools.bench.chart, tools.bench.stress, tools.relight.
"""
