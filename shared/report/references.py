"""The literature that the methods text may cite."""

REFERENCES = {
    "xu2025": "Xu et al., Monocular Facial Appearance Capture in the Wild. ICCV 2025.",
    "molder2021": "Mölder et al., Sustainable data analysis with Snakemake. F1000Research 10:33, 2021.",
    "harris2020": "Harris et al., Array programming with NumPy. Nature 585, 2020.",
    "virtanen2020":
        "Virtanen et al., SciPy 1.0: fundamental algorithms for scientific computing in Python. Nature "
        "Methods 17, 2020.",
    "paszke2019": "Paszke et al., PyTorch: An Imperative Style, High-Performance Deep Learning Library. NeurIPS 2019.",
    "lam2015": "Lam, Pitrou, Seibert, Numba: a LLVM-based Python JIT compiler. LLVM-HPC 2015.",
    "bradski2000": "Bradski, The OpenCV Library. Dr. Dobb's Journal of Software Tools, 2000.",
    "bazarevsky2019":
        "Bazarevsky et al., BlazeFace: Sub-millisecond Neural Face Detection on Mobile GPUs. arXiv "
        "1907.05047, 2019.",
    "kartynnik2019":
        "Kartynnik et al., Real-time Facial Surface Geometry from Monocular Video on Mobile GPUs. arXiv "
        "1907.06724, 2019.",
    "kroeger2016": "Kroeger et al., Fast Optical Flow using Dense Inverse Search. ECCV 2016.",
    "kalal2010":
        "Kalal, Mikolajczyk, Matas, Forward-Backward Error: Automatic Detection of Tracking Failures. ICPR "
        "2010.",
    "baker2004":
        "Baker, Matthews, Lucas-Kanade 20 Years On: A Unifying Framework. International Journal of Computer "
        "Vision 56, 2004.",
    "triggs2000":
        "Triggs et al., Bundle Adjustment - A Modern Synthesis. Vision Algorithms: Theory and Practice, 2000.",
    "blanz1999": "Blanz, Vetter, A Morphable Model for the Synthesis of 3D Faces. SIGGRAPH 1999.",
    "chen1992":
        "Chen, Medioni, Object modelling by registration of multiple range images. Image and Vision Computing"
        " 10, 1992.",
    "botsch2008":
        "Botsch, Sorkine, On Linear Variational Surface Deformation Methods. IEEE Transactions on "
        "Visualization and Computer Graphics 14, 2008.",
    "walter2007": "Walter et al., Microfacet Models for Refraction through Rough Surfaces. EGSR 2007.",
    "schlick1994":
        "Schlick, An Inexpensive BRDF Model for Physically-based Rendering. Computer Graphics Forum 13, 1994.",
    "burley2012": "Burley, Physically-Based Shading at Disney. SIGGRAPH courses, 2012.",
    "wald2014":
        "Wald et al., Embree: A Kernel Framework for Efficient CPU Ray Tracing. ACM Transactions on Graphics "
        "33, 2014.",
    "goral1984": "Goral et al., Modeling the Interaction of Light Between Diffuse Surfaces. SIGGRAPH 1984.",
    "sloan2002":
        "Sloan, Kautz, Snyder, Precomputed Radiance Transfer for Real-Time Rendering in Dynamic, Low-"
        "Frequency Lighting Environments. SIGGRAPH 2002.",
    "ramamoorthi2001":
        "Ramamoorthi, Hanrahan, An Efficient Representation for Irradiance Environment Maps. SIGGRAPH 2001.",
    "ren2006":
        "Ren et al., Real-time Soft Shadows in Dynamic Scenes using Spherical Harmonic Exponentiation. "
        "SIGGRAPH 2006.",
    "breiman1984": "Breiman et al., Classification and Regression Trees. Wadsworth, 1984.",
    "golub1973":
        "Golub, Pereyra, The Differentiation of Pseudo-Inverses and Nonlinear Least Squares Problems Whose "
        "Variables Separate. SIAM Journal on Numerical Analysis 10, 1973.",
    "kaufman1975":
        "Kaufman, A variable projection method for solving separable nonlinear least squares problems. BIT "
        "15, 1975.",
    "nicolet2021": "Nicolet, Jacobson, Jakob, Large Steps in Inverse Rendering of Geometry. SIGGRAPH Asia 2021.",
    "karis2013": "Karis, Real Shading in Unreal Engine 4. SIGGRAPH courses, 2013.",
    "cipolla2000": "Cipolla, Giblin, Visual Motion of Curves and Surfaces. Cambridge University Press, 2000.",
    "mccamy1976":
        "McCamy, Marcus, Davidson, A Color-Rendition Chart. Journal of Applied Photographic Engineering 2, "
        "1976.",
}
