"""What `limn` does: subjects, plan, workflow and its engine, status, quality gates, summary, housekeeping.

Read in this order: cases, records, plan, measures, review_picture, gates, watch, outcome, resources, cluster,
snakemake_process, engine, summary, thumbnails, overview, workflow, housekeeping, status, new_subject, validate,
check_export.
May import: shared, stages.
"""
