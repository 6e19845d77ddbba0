//! Which views observe a point, and with that the right tracks.

use nalgebra::Vector3;
use rand::Rng;
use rand_chacha::ChaCha8Rng;

use super::stream::Stream;
use super::{PhotographedOptions, Seen, Track, VisibilityKind, points};
use crate::domain::error::{InvalidInput, Violation};
use crate::synthetic::scene::Camera;

/// Points drawn for one track before the best of them is taken, and before there is none.
const MOST_DRAWS: usize = 40;
const DRAWS_FOR_ANY: usize = 4_000;

/// Distance from the border of the image that exact places keep, so that the noise does not carry them out of it: far
/// in the tails.
pub fn border_px(options: &PhotographedOptions) -> f64 {
    10.0 * options.noise_px
}

/// A right track for every track, all of its observations right.
///
/// # Errors
/// A motion under which no two views see a common point.
pub fn draw_tracks(options: &PhotographedOptions, cameras: &[Camera]) -> Result<Vec<Track>, InvalidInput> {
    let mut rng = Stream::Points.of(options.seed);
    (0..options.tracks).map(|_| draw_track(options, cameras, &mut rng)).collect()
}

fn draw_track(options: &PhotographedOptions, cameras: &[Camera], rng: &mut ChaCha8Rng) -> Result<Track, InvalidInput> {
    let length = rng.random_range(options.lifetime.0..=options.lifetime.1);
    let wanted = match options.visibility {
        VisibilityKind::Banded => length.min(options.views),
        VisibilityKind::Scattered => 2,
    };
    let mut longest: Option<Track> = None;
    for draw in 0..DRAWS_FOR_ANY {
        let found = longest.as_ref().map_or(0, |track| track.seen.len());
        if found >= wanted || (found >= 2 && draw >= MOST_DRAWS) {
            break;
        }
        let view = rng.random_range(0..cameras.len());
        let Some(point) = points::draw(options, &cameras[view], border_px(options), rng) else { continue };
        let before = before(options, cameras, view, &point);
        let seen = observed(options, before, view, length, rng);
        if seen.len() >= 2.max(found + 1) {
            longest = Some(Track { point, second_body: false, seen });
        }
    }
    longest.ok_or_else(|| {
        let reason = format!("no two views of {} have a point in common", options.motion.name());
        Violation::of("turn_rad", reason).into()
    })
}

/// The views that a point is before, with its image, in order.
fn before(options: &PhotographedOptions, cameras: &[Camera], drawn_in: usize, point: &Vector3<f64>) -> Vec<Seen> {
    let image = |(view, camera): (usize, &Camera)| {
        let image = points::image(camera, point, border_px(options))?;
        points::is_alike(&cameras[drawn_in], camera, point).then(|| Seen::right(view, image))
    };
    cameras.iter().enumerate().filter_map(image).collect()
}

/// Those of the views that a point is before which observe it.
///
/// * `about`: a view that is among them where the visibility is banded
/// * `length`: how many views in a row observe it, where so many are before it
pub fn observed(
    options: &PhotographedOptions,
    before: Vec<Seen>,
    about: usize,
    length: usize,
    rng: &mut ChaCha8Rng,
) -> Vec<Seen> {
    match options.visibility {
        VisibilityKind::Scattered => before.into_iter().filter(|_| rng.random::<f64>() < options.seen_share).collect(),
        VisibilityKind::Banded => {
            let Some(place) = before.iter().position(|seen| seen.view == about) else { return Vec::new() };
            let in_row = |k: usize| before[k].view + place == about + k;
            let first = (0..place).rev().take_while(|&k| in_row(k)).last().unwrap_or(place);
            let last = (place..before.len()).take_while(|&k| in_row(k)).last().unwrap_or(place);
            let length = length.min(last - first + 1);
            let from = rng.random_range(first.max((place + 1).saturating_sub(length))..=place.min(last + 1 - length));
            before[from..from + length].to_vec()
        }
    }
}

impl Seen {
    /// A right observation.
    pub fn right(view: usize, image: [f64; 2]) -> Self {
        Self { view, image, right: true, of_other: false, noise: 1.0 }
    }

    /// The same with a wrong place.
    pub fn moved(self, image: [f64; 2]) -> Self {
        Self { image, right: false, ..self }
    }
}
