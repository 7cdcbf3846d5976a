"""The papers behind the recipes on Gaussians, and where the recipes depart from them."""

from dataclasses import replace

from sharpfield.core.paper import Paper
from sharpfield.recipes.hybrid import PAPER as HYBRID

KERBL = Paper(
    key="kerbl2023gaussians",
    title="3D Gaussian Splatting for Real-Time Radiance Field Rendering",
    bibtex="""@article{kerbl2023gaussians,
  title   = {{3D} Gaussian Splatting for Real-Time Radiance Field Rendering},
  author  = {Kerbl, Bernhard and Kopanas, Georgios and Leimk{\\"u}hler, Thomas and
             Drettakis, George},
  journal = {ACM Transactions on Graphics},
  volume  = {42},
  number  = {4},
  year    = {2023}
}""",
    departures=(
        "Gaussians hold stored colours, but light is blended: a view is encoded as frames are"
        " only after blending, because blur adds up light.",
        "The loss is the mean absolute difference alone, without structural similarity.",
        "Dead Gaussians are relocated to live ones (MCMC, NeurIPS 2024) unless"
        " gaussians.growth is `densify`.",
        "Splats thinner than a pixel are rendered fainter (Mip-Splatting, CVPR 2024).",
    ),
)

PAN = Paper(
    key="pan2019edi",
    title="Bringing a Blurry Frame Alive at High Frame-Rate with an Event Camera",
    bibtex="""@inproceedings{pan2019edi,
  title     = {Bringing a Blurry Frame Alive at High Frame-Rate with an Event Camera},
  author    = {Pan, Liyuan and Scheerlinck, Cedric and Yu, Xin and Hartley, Richard and
               Liu, Miaomiao and Dai, Yuchao},
  booktitle = {IEEE/CVF Conference on Computer Vision and Pattern Recognition (CVPR)},
  year      = {2019}
}""",
    departures=KERBL.departures,
)

ZHAO = Paper(
    key="zhao2024badgaussians",
    title="BAD-Gaussians: Bundle Adjusted Deblur Gaussian Splatting",
    bibtex="""@inproceedings{zhao2024badgaussians,
  title     = {{BAD-Gaussians}: Bundle Adjusted Deblur Gaussian Splatting},
  author    = {Zhao, Lingzhe and Wang, Peng and Liu, Peidong},
  booktitle = {European Conference on Computer Vision (ECCV)},
  year      = {2024}
}""",
    departures=(
        *KERBL.departures,
        "Where the capture knows the motion of the camera it is used, with a smooth learned"
        " correction; only photos of unknown motion get a motion of their own.",
        "That motion is a cubic B-spline of twists, not a line.",
    ),
)

XIONG = Paper(
    key="xiong2024event3dgs",
    title="Event3DGS: Event-Based 3D Gaussian Splatting for High-Speed Robot Egomotion",
    bibtex="""@inproceedings{xiong2024event3dgs,
  title     = {{Event3DGS}: Event-Based {3D} Gaussian Splatting for High-Speed Robot Egomotion},
  author    = {Xiong, Tianyi and Wu, Jiayi and He, Botao and Fermuller, Cornelia and
               Aloimonos, Yiannis and Huang, Heng and Metzler, Christopher},
  booktitle = {Conference on Robot Learning (CoRL)},
  year      = {2024}
}""",
    departures=(
        *KERBL.departures,
        "Windows of random length are counted exactly; silent pixels may change by a threshold.",
    ),
)

OURS = Paper(
    key="sharpfield-ev-splat",
    title="Gaussians from blurry frames and events (sharpfield)",
    bibtex="""@software{sharpfield,
  title = {sharpfield: sharp radiance fields from blurry frames and events},
  note  = {Recipe ev-splat. It builds on the event double integral (Pan et al., CVPR 2019), on
           3D Gaussian splatting (Kerbl et al., SIGGRAPH 2023) and its Markov chain Monte Carlo
           view (Kheradmand et al., NeurIPS 2024)}
}""",
)

DAI = replace(
    HYBRID,
    departures=(
        "Gaussians instead of neural points and image features.",
        "Blur is the mean of views along the camera's motion, instead of a kernel for each patch.",
        "Frames are sampled as often as their quality says, instead of weighting their loss.",
        "What the depth camera measured is a loss, too.",
    ),
)

LI = Paper(
    key="li2024spacetime",
    title="Spacetime Gaussian Feature Splatting for Real-Time Dynamic View Synthesis",
    bibtex="""@inproceedings{li2024spacetime,
  title     = {Spacetime {Gaussian} Feature Splatting for Real-Time Dynamic View Synthesis},
  author    = {Li, Zhan and Chen, Zhang and Li, Zhong and Xu, Yi},
  booktitle = {IEEE/CVF Conference on Computer Vision and Pattern Recognition (CVPR)},
  year      = {2024}
}""",
    departures=(
        "Gaussians have one colour each: there are no features that a network turns into colours.",
        "They are opaque for most of their time and then fade fast, exp(-d^4/2) for exp(-d^2/2).",
        "What does not move are static Gaussians, before a background of one colour.",
        "Moving ones start in the visual hull of each moment, not at structure-from-motion points.",
        "The loss is the mean absolute difference alone, without structural similarity.",
    ),
)

OURS_MOVING = Paper(
    key="sharpfield-ev-dynamic-splat",
    title="Moving Gaussians from frames and events of many cameras (sharpfield)",
    bibtex="""@software{sharpfield,
  title = {sharpfield: sharp radiance fields from blurry frames and events},
  note  = {Recipe ev-dynamic-splat. It builds on spacetime Gaussians (Li et al.,
           CVPR 2024), on the event double integral (Pan et al., CVPR 2019) and on EvDNeRF
           (Bhattacharya et al., WACV 2024)}
}""",
)
