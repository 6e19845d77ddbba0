//! Where the points of a scene lie, and what the camera that sees them is like.

use nalgebra::Vector3;
use rand::Rng;
use rand_chacha::ChaCha8Rng;

use super::draw::{chance, in_cube, log_uniform, normals, uniform};
use crate::synthetic::scene::{FOCAL_RANGE_PX, IMAGE_SIDE_PX};

/// Share of the scenes whose world is the paper's box (its section 5.1). The rest are wider worlds: the network shall
/// not learn one box by heart.
const PAPER_BOXES: f64 = 0.5;
/// The box: sides of 2 about a centre at this distance.
const BOX_DISTANCE: f64 = 3.0;
/// Largest rotation and translation of the paper's cameras.
const BOX_LIMITS: Limits = Limits { turn_rad: 0.4, travel: 1.0 };

/// Distance of the centre of a wider world, and half of its extent along and across the axis; the shallow ones are
/// slabs parallel to the image.
const DISTANCE: (f64, f64) = (2.5, 7.0);
const HALF_DEPTH: (f64, f64) = (0.05, 1.5);
const HALF_WIDTH: (f64, f64) = (0.6, 1.6);
/// Focal length in image widths, from fisheye-like wide angle to a telephoto lens.
const FOCAL: (f64, f64) = (0.3, 3.0);
/// Largest rotations and translations of the cameras in a wider world.
const TURN_RAD: (f64, f64) = (0.05, 0.6);
const TRAVEL: (f64, f64) = (0.2, 1.2);

/// Share of the wider worlds whose points are spread evenly; the rest come in clusters, as textured objects do.
const EVEN: f64 = 0.5;
/// How many clusters, how large as a share of the world's half extent, and how flat half of them are.
const CLUSTERS: std::ops::RangeInclusive<usize> = 2..=5;
const CLUSTER_SIZE: (f64, f64) = (0.1, 0.4);
const FLAT: f64 = 0.05;
/// How far the outermost point of a cluster may lie, in half extents: normals have no end, images do.
const FARTHEST: f64 = 1.5;

/// How far the cameras go: rotations in radians, translations in the world's unit.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Limits {
    pub turn_rad: f64,
    pub travel: f64,
}

/// Points and the camera's focal length.
#[derive(Debug, Clone, PartialEq)]
pub struct World {
    /// One a track, in front of an unmoved camera or beside it.
    pub points: Vec<Vector3<f64>>,
    /// What cameras turn about where they turn about the scene.
    pub centre: Vector3<f64>,
    /// In image widths.
    pub focal: f64,
    pub limits: Limits,
}

impl World {
    pub fn draw(tracks: usize, rng: &mut ChaCha8Rng) -> Self {
        if chance(PAPER_BOXES, rng) { Self::paper_box(tracks, rng) } else { Self::wide(tracks, rng) }
    }

    fn paper_box(tracks: usize, rng: &mut ChaCha8Rng) -> Self {
        let side_px = f64::from(IMAGE_SIDE_PX);
        let centre = Vector3::new(0.0, 0.0, BOX_DISTANCE);
        Self {
            points: (0..tracks).map(|_| centre + in_cube(rng)).collect(),
            centre,
            focal: uniform((FOCAL_RANGE_PX.0 / side_px, FOCAL_RANGE_PX.1 / side_px), rng),
            limits: BOX_LIMITS,
        }
    }

    fn wide(tracks: usize, rng: &mut ChaCha8Rng) -> Self {
        let centre = Vector3::new(0.0, 0.0, uniform(DISTANCE, rng));
        let half_width = uniform(HALF_WIDTH, rng);
        let half_extent = Vector3::new(half_width, half_width, uniform(HALF_DEPTH, rng));
        let unit = if chance(EVEN, rng) { (0..tracks).map(|_| in_cube(rng)).collect() } else { clusters(tracks, rng) };
        Self {
            points: unit.into_iter().map(|point| centre + point.component_mul(&half_extent)).collect(),
            centre,
            focal: log_uniform(FOCAL, rng),
            limits: Limits { turn_rad: uniform(TURN_RAD, rng), travel: uniform(TRAVEL, rng) },
        }
    }
}

/// Points in a few clusters, in half extents of the world.
fn clusters(tracks: usize, rng: &mut ChaCha8Rng) -> Vec<Vector3<f64>> {
    let centres: Vec<Vector3<f64>> = (0..rng.random_range(CLUSTERS)).map(|_| in_cube(rng)).collect();
    let size = uniform(CLUSTER_SIZE, rng);
    let size = Vector3::new(size, size, if chance(0.5, rng) { size * FLAT } else { size });
    (0..tracks)
        .map(|_| {
            let centre = centres[rng.random_range(0..centres.len())];
            (centre + normals(rng).component_mul(&size)).map(|x| x.clamp(-FARTHEST, FARTHEST))
        })
        .collect()
}
