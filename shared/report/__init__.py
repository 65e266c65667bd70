"""Pages and pictures on which a person judges a result.

Read in this order: content, gather, pictures, charts, advice, sections, model_sections, view_sections, viewer, page,
build, references, methods, contact_sheet, tracking_overlay, tracking_pictures, shape_pictures.
May import: contract, geometry, imaging, io, capture, tracking, rendering.
"""
