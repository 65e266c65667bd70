"""Pages and pictures on which a person judges a result.

Read in this order: advice, pictures, eye_pictures, content, template, charts, viewer, page, references, methods,
contact_sheet, tracking_pictures, shape_pictures. What pages look like stands in templates/.
May import: contract, geometry, imaging, io, capture, tracking, rendering.
"""
