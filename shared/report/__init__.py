"""Pages and pictures on which a person judges a result.

Read in this order: advice, content, pictures, template, charts, viewer, page, references, methods, contact_sheet,
tracking_pictures, shape_pictures. What pages look like stands in templates/.
May import: contract, geometry, imaging, io, capture, tracking, rendering.
"""
