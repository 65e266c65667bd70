"""Files in and out: pictures, video, meshes, USD and glTF. What is wrong with a file is said in one line.

Read in this order: arrays, orientation, pixel_format, colour_tags, source, exr_header, images, image_tags,
exr_picture, image_sequence, video, frames, plates, meshes, material_maps, export_maps, usd_variants, usd_material,
usd_capture, usd_actions, usd_detail, usd, usd_validate, usdz, gltf, gltf_validate, exr_checks, export_checks.
May import: errors, geometry, imaging.
"""
