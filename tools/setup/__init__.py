"""Set-up and upkeep of an installation: models, head model, host, optional parts, licences.

Read in this order: models, host, packages, sbom, audit, test_all.
May import: shared, tools.bench.peers, tools.setup.head_model.
"""
