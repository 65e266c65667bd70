"""The literature that docstrings and comments cite as [Key], and the methods text as {Key}: docs/bibliography.md."""

REFERENCES = {
    "Ablavatski2020":
        "Ablavatski et al., Real-time Pupil Tracking from Monocular Video for Digital Puppetry. arXiv 2006.11341, "
        "2020.",
    "Arvo1994": "Arvo, The Irradiance Jacobian for Partially Occluded Polyhedral Sources. SIGGRAPH 1994.",
    "Baker2004":
        "Baker, Matthews, Lucas-Kanade 20 Years On: A Unifying Framework. International Journal of Computer Vision "
        "56, 2004.",
    "Bazarevsky2019":
        "Bazarevsky et al., BlazeFace: Sub-millisecond Neural Face Detection on Mobile GPUs. arXiv 1907.05047, 2019.",
    "Beaton1974":
        "Beaton, Tukey, The Fitting of Power Series, Meaning Polynomials, Illustrated on Band-Spectroscopic Data. "
        "Technometrics 16, 1974.",
    "Becker1988":
        "Becker, Fuchs, Lid-Eye Coordination During Vertical Gaze Changes in Man and Monkey. Journal of "
        "Neurophysiology 60, 1988.",
    "Bekerman2014":
        "Bekerman, Gottlieb, Vaiman, Variations in Eyeball Diameters of the Healthy Adults. Journal of Ophthalmology, "
        "2014.",
    "Blanz1999": "Blanz, Vetter, A Morphable Model for the Synthesis of 3D Faces. SIGGRAPH 1999.",
    "Botsch2008":
        "Botsch, Sorkine, On Linear Variational Surface Deformation Methods. IEEE Transactions on Visualization and "
        "Computer Graphics 14, 2008.",
    "Boubekeur2008": "Boubekeur, Alexa, Phong Tessellation. SIGGRAPH Asia 2008.",
    "Bouguet2000": "Bouguet, Pyramidal Implementation of the Lucas Kanade Feature Tracker. Intel Corporation, 2000.",
    "Bradski2000": "Bradski, The OpenCV Library. Dr. Dobb's Journal of Software Tools, 2000.",
    "Breiman1984": "Breiman et al., Classification and Regression Trees. Wadsworth, 1984.",
    "Burley2012": "Burley, Physically-Based Shading at Disney. SIGGRAPH courses, 2012.",
    "Burt1983":
        "Burt, Adelson, The Laplacian Pyramid as a Compact Image Code. IEEE Transactions on Communications 31, 1983.",
    "Carpenter1988": "Carpenter, Movements of the Eyes. Pion, 1988.",
    "Catmull1978":
        "Catmull, Clark, Recursively generated B-spline surfaces on arbitrary topological meshes. Computer-Aided "
        "Design 10, 1978.",
    "Chandrasekhar1960": "Chandrasekhar, Radiative Transfer. Dover, 1960.",
    "Chen1992":
        "Chen, Medioni, Object modelling by registration of multiple range images. Image and Vision Computing 10, "
        "1992.",
    "Chuang2001": "Chuang et al., A Bayesian Approach to Digital Matting. CVPR 2001.",
    "Cipolla2000": "Cipolla, Giblin, Visual Motion of Curves and Surfaces. Cambridge University Press, 2000.",
    "Collins2014":
        "Collins, Bartoli, Infinitesimal Plane-Based Pose Estimation. International Journal of Computer Vision 109, "
        "2014.",
    "Daugman1993":
        "Daugman, High Confidence Visual Recognition of Persons by a Test of Statistical Independence. IEEE "
        "Transactions on Pattern Analysis and Machine Intelligence 15, 1993.",
    "Dempster1977":
        "Dempster, Laird, Rubin, Maximum Likelihood from Incomplete Data via the EM Algorithm. Journal of the Royal "
        "Statistical Society B 39, 1977.",
    "Ding2006":
        "Ding et al., Refractive Indices of Human Skin Tissues at Eight Wavelengths and Estimated Dispersion Relations "
        "Between 300 and 1600 nm. Physics in Medicine and Biology 51, 2006.",
    "Duff2017":
        "Duff et al., Building an Orthonormal Basis, Revisited. Journal of Computer Graphics Techniques 6, 2017.",
    "Dupuy2023": "Dupuy, Benyoub, Sampling Visible GGX Normals with Spherical Caps. Computer Graphics Forum 42, 2023.",
    "Efron1982": "Efron, The Jackknife, the Bootstrap and Other Resampling Plans. SIAM, 1982.",
    "Fry1962": "Fry, Hill, The Center of Rotation of the Eye. American Journal of Optometry 39, 1962.",
    "Garland1998": "Garland, Heckbert, Simplifying Surfaces with Color and Texture using Quadric Error Metrics. IEEE "
                   "Visualization 1998.",
    "Geman1985":
        "Geman, McClure, Bayesian Image Analysis: An Application to Single Photon Emission Tomography. American "
        "Statistical Association, 1985.",
    "Geweke1989":
        "Geweke, Bayesian Inference in Econometric Models Using Monte Carlo Integration. Econometrica 57 (6), 1989.",
    "Golub1973":
        "Golub, Pereyra, The Differentiation of Pseudo-Inverses and Nonlinear Least Squares Problems Whose Variables "
        "Separate. SIAM Journal on Numerical Analysis 10, 1973.",
    "Goral1984": "Goral et al., Modeling the Interaction of Light Between Diffuse Surfaces. SIGGRAPH 1984.",
    "Gortler1996": "Gortler et al., The Lumigraph. SIGGRAPH 1996.",
    "Halstead1993":
        "Halstead, Kass, DeRose, Efficient, Fair Interpolation using Catmull-Clark Surfaces. SIGGRAPH 1993.",
    "Harris2020": "Harris et al., Array programming with NumPy. Nature 585, 2020.",
    "He2010": "He, Sun, Tang, Guided Image Filtering. ECCV 2010.",
    "He2013":
        "He, Sun, Tang, Guided Image Filtering. IEEE Transactions on Pattern Analysis and Machine Intelligence 35 (6), "
        "2013.",
    "He2015": "He, Sun, Fast Guided Filter. arXiv 1505.00996, 2015.",
    "Hoppe1999": "Hoppe, New Quadric Metric for Simplifying Meshes with Appearance Attributes. IEEE Visualization "
                 "1999.",
    "Horn1975": "Horn, Obtaining Shape from Shading Information. The Psychology of Computer Vision, McGraw-Hill 1975.",
    "Immerkaer1996": "Immerkaer, Fast Noise Variance Estimation. Computer Vision and Image Understanding 64, 1996.",
    "Irons1969":
        "Irons, Tuck, A Version of the Aitken Accelerator for Computer Iteration. International Journal for Numerical "
        "Methods in Engineering 1, 1969.",
    "Jakob2022": "Jakob et al., Mitsuba 3 renderer. 2022.",
    "Jensen2001": "Jensen et al., A Practical Model for Subsurface Light Transport. SIGGRAPH 2001.",
    "Kabsch1976":
        "Kabsch, A Solution for the Best Rotation to Relate Two Sets of Vectors. Acta Crystallographica A32, 1976.",
    "Kalal2010":
        "Kalal, Mikolajczyk, Matas, Forward-Backward Error: Automatic Detection of Tracking Failures. ICPR 2010.",
    "Karis2013": "Karis, Real Shading in Unreal Engine 4. SIGGRAPH courses, 2013.",
    "Kartynnik2019":
        "Kartynnik et al., Real-time Facial Surface Geometry from Monocular Video on Mobile GPUs. arXiv 1907.06724, "
        "2019.",
    "Kaufman1975":
        "Kaufman, A variable projection method for solving separable nonlinear least squares problems. BIT 15, 1975.",
    "Kish1965": "Kish, Survey Sampling. Wiley 1965.",
    "Krahenbuhl2011":
        "Krahenbuhl, Koltun, Efficient Inference in Fully Connected CRFs with Gaussian Edge Potentials. NIPS 2011.",
    "Kroeger2016": "Kroeger et al., Fast Optical Flow using Dense Inverse Search. ECCV 2016.",
    "Kuhl1982":
        "Kuhl, Giardina, Elliptic Fourier Features of a Closed Contour. Computer Graphics and Image Processing 18, "
        "1982.",
    "Kutulakos2000":
        "Kutulakos, Seitz, A Theory of Shape by Space Carving. International Journal of Computer Vision 38 (3), 2000.",
    "Laine2020": "Laine et al., Modular Primitives for High-Performance Differentiable Rendering. SIGGRAPH Asia 2020.",
    "Lam1985": "Lam, Metamerism and Colour Constancy. PhD thesis, University of Bradford, 1985.",
    "Lam2015": "Lam, Pitrou, Seibert, Numba: a LLVM-based Python JIT compiler. LLVM-HPC 2015.",
    "Lange1989":
        "Lange, Little, Taylor, Robust Statistical Modeling Using the t Distribution. Journal of the American "
        "Statistical Association 84, 1989.",
    "Laurentini1994":
        "Laurentini, The Visual Hull Concept for Silhouette-Based Image Understanding. IEEE Transactions on Pattern "
        "Analysis and Machine Intelligence 16 (2), 1994.",
    "Lepetit2009":
        "Lepetit, Moreno-Noguer, Fua, EPnP: An Accurate O(n) Solution to the PnP Problem. International Journal of "
        "Computer Vision 81, 2009.",
    "Levenberg1944":
        "Levenberg, A Method for the Solution of Certain Non-Linear Problems in Least Squares. Quarterly of Applied "
        "Mathematics 2, 1944.",
    "Liang1986":
        "Liang, Zeger, Longitudinal Data Analysis Using Generalized Linear Models. Biometrika 73, 1986.",
    "Loop1987": "Loop, Smooth Subdivision Surfaces Based on Triangles. Master's thesis, University of Utah, 1987.",
    "Lu2025":
        "Lu, Xiao, Pointer et al., The International Skin Spectra Archive (ISSA): A Multicultural Human Skin Phenotype "
        "and Colour Spectra Collection. Scientific Data 12, 2025.",
    "Mackay1992": "MacKay, Bayesian Interpolation. Neural Computation 4 (3), 1992.",
    "Mccamy1976":
        "McCamy, Marcus, Davidson, A Color-Rendition Chart. Journal of Applied Photographic Engineering 2, 1976.",
    "Mikkelsen2008":
        "Mikkelsen, Simulation of Wrinkled Surfaces Revisited. Master's thesis, University of Copenhagen, 2008.",
    "Moeller1997":
        "Möller, Trumbore, Fast, Minimum Storage Ray-Triangle Intersection. Journal of Graphics Tools 2, 1997.",
    "Molder2021": "Mölder et al., Sustainable data analysis with Snakemake. F1000Research 10:33, 2021.",
    "Munkberg2022": "Munkberg et al., Extracting Triangular 3D Models, Materials, and Lighting From Images. CVPR 2022.",
    "Nicolet2021": "Nicolet, Jacobson, Jakob, Large Steps in Inverse Rendering of Geometry. SIGGRAPH Asia 2021.",
    "Nishino2004": "Nishino, Nayar, Eyes for Relighting. ACM Transactions on Graphics 23, 2004.",
    "Noh2001": "Noh, Neumann, Expression Cloning. SIGGRAPH 2001.",
    "Paszke2019": "Paszke et al., PyTorch: An Imperative Style, High-Performance Deep Learning Library. NeurIPS 2019.",
    "Porter1984": "Porter, Duff, Compositing Digital Images. SIGGRAPH 1984.",
    "Ramamoorthi2001":
        "Ramamoorthi, Hanrahan, An Efficient Representation for Irradiance Environment Maps. SIGGRAPH 2001.",
    "Rasmussen2006": "Rasmussen, Williams, Gaussian Processes for Machine Learning. MIT Press, 2006.",
    "Rauch1965": "Rauch, Tung, Striebel, Maximum Likelihood Estimates of Linear Dynamic Systems. AIAA Journal 3, 1965.",
    "Ren2006":
        "Ren et al., Real-time Soft Shadows in Dynamic Scenes using Spherical Harmonic Exponentiation. SIGGRAPH 2006.",
    "Rue2005": "Rue, Held, Gaussian Markov Random Fields: Theory and Applications. Chapman and Hall, 2005.",
    "Ruefer2005":
        "Rüfer, Schröder, Erb, White-to-White Corneal Diameter: Normal Values in Healthy Humans Obtained with the "
        "Orbscan II Topography System. Cornea 24, 2005.",
    "Saad2003": "Saad, Iterative Methods for Sparse Linear Systems, second edition. SIAM, 2003.",
    "Schaefer2006": "Schaefer, McPhail, Warren, Image Deformation Using Moving Least Squares. SIGGRAPH 2006.",
    "Schlick1994":
        "Schlick, An Inexpensive BRDF Model for Physically-based Rendering. Computer Graphics Forum 13, 1994.",
    "Schwarz1978": "Schwarz, Estimating the Dimension of a Model. Annals of Statistics 6 (2), 1978.",
    "Shi1994": "Shi, Tomasi, Good Features to Track. CVPR 1994.",
    "Sloan2002":
        "Sloan, Kautz, Snyder, Precomputed Radiance Transfer for Real-Time Rendering in Dynamic, Low-Frequency "
        "Lighting Environments. SIGGRAPH 2002.",
    "Smith2015": "Smith, Schaefer, Bijective Parameterization with Free Boundaries. SIGGRAPH 2015.",
    "Smith2019":
        "Smith, de Goes, Kim, Analytic Eigensystems for Isotropic Distortion Energies. ACM Transactions on Graphics "
        "38, 2019.",
    "Stone1977":
        "Stone, An Asymptotic Equivalence of Choice of Model by Cross-Validation and Akaike's Criterion. Journal of "
        "the Royal Statistical Society B 39 (1), 1977.",
    "Szeliski1997":
        "Szeliski, Kang, Shape Ambiguities in Structure from Motion. IEEE Transactions on Pattern Analysis and "
        "Machine Intelligence 19, 1997.",
    "Tabatabai1984":
        "Tabatabai, Mitchell, Edge Location to Subpixel Values in Digital Imagery. IEEE Transactions on Pattern "
        "Analysis and Machine Intelligence 6 (2), 1984.",
    "Thuermer1998":
        "Thürmer, Wüthrich, Computing Vertex Normals from Polygonal Facets. Journal of Graphics Tools 3, 1998.",
    "Triggs2000":
        "Triggs et al., Bundle Adjustment - A Modern Synthesis. Vision Algorithms: Theory and Practice, 2000.",
    "Tsumura2003":
        "Tsumura et al., Image-Based Skin Color and Texture Analysis/Synthesis by Extracting Hemoglobin and Melanin "
        "Information in the Skin. SIGGRAPH 2003.",
    "Tutte1963": "Tutte, How to Draw a Graph. Proceedings of the London Mathematical Society 13, 1963.",
    "Umeyama1991":
        "Umeyama, Least-Squares Estimation of Transformation Parameters Between Two Point Patterns. IEEE Transactions"
        " on Pattern Analysis and Machine Intelligence 13, 1991.",
    "Veach1995": "Veach, Guibas, Optimally Combining Sampling Techniques for Monte Carlo Rendering. SIGGRAPH 1995.",
    "Vicini2021": "Vicini, Speierer, Jakob, Path Replay Backpropagation. SIGGRAPH 2021.",
    "Virtanen2020":
        "Virtanen et al., SciPy 1.0: fundamental algorithms for scientific computing in Python. Nature Methods 17, "
        "2020.",
    "Wald2014":
        "Wald et al., Embree: A Kernel Framework for Efficient CPU Ray Tracing. ACM Transactions on Graphics 33, "
        "2014.",
    "Walter2007": "Walter et al., Microfacet Models for Refraction through Rough Surfaces. EGSR 2007.",
    "Wang1994":
        "Wang, Adelson, Representing Moving Images with Layers. IEEE Transactions on Image Processing 3, 1994.",
    "Wang2004":
        "Wang et al., Image Quality Assessment: From Error Visibility to Structural Similarity. IEEE Transactions on "
        "Image Processing 13, 2004.",
    "Wang2009": "Wang et al., All-Frequency Rendering of Dynamic, Spatially-Varying Reflectance. SIGGRAPH Asia 2009.",
    "Wedderburn1974":
        "Wedderburn, Quasi-Likelihood Functions, Generalized Linear Models, and the Gauss-Newton Method. Biometrika "
        "61, 1974.",
    "Weyrich2006":
        "Weyrich et al., Analysis of Human Faces Using a Measurement-Based Skin Reflectance Model. SIGGRAPH 2006.",
    "Xu2025": "Xu et al., Monocular Facial Appearance Capture in the Wild. ICCV 2025.",
    "Yoshida2013":
        "Yoshida et al., Application of the Critical Angle Method to Refractive Index Measurement of Human Skin In "
        "Vivo Under Partial Contact. Journal of Biomedical Optics 18, 2013.",
}
