//! What is wrong with the wrong tracks.

use std::f64::consts::TAU;

use nalgebra::Vector3;
use rand::Rng;
use rand::seq::SliceRandom;
use rand_chacha::ChaCha8Rng;

use super::motion::{DISTANCE, Path};
use super::stream::Stream;
use super::visibility::{border_px, observed};
use super::{PhotographedMotion, PhotographedOptions, Seen, Track, VERIFIABLE, WrongKind, points, second_body};
use crate::synthetic::scene::{Camera, slide};

/// Speed of a drift in pixels a view: at its slowest ten times the noise after three views.
const DRIFT_PX: (f64, f64) = (4.0, 15.0);
/// Noise of what is static in the image, as a share of that of the scene: it has no motion blur and no parallax, but
/// the detector's error.
const STATIC_NOISE: f64 = 0.5;
/// Distance of the copies of a repeated structure in the world, windows of a facade: far above the noise.
const REPEATED_DISTANCE: (f64, f64) = (0.1 * DISTANCE, 0.25 * DISTANCE);
/// Copies that a point is taken for, the first of them that is in the image and far enough away.
const NEIGHBOURS: [f64; 6] = [1.0, -1.0, 2.0, -2.0, 3.0, -3.0];
/// Pixels by which what slides or repeats must be off, or it is anywhere in the image instead: near an epipole, where a
/// row of copies leads away from the camera, and under a camera that stays in place, it would hide in the noise.
const LEAST_OFF_PX: f64 = 15.0;
/// Wrong tracks that near-duplicates are copies of, at most, and how far a copy is off along each axis.
const ORIGINALS: usize = 3;
const COPIED_WITHIN_PX: f64 = 0.3;
/// Points of the second body drawn for one track before it is anywhere in the images instead.
const BODY_DRAWS: usize = 400;
/// Other points drawn for a track that is to go over to one.
const LINK_DRAWS: usize = 400;

/// Spoils the tracks that are wrong.
pub fn apply(options: &PhotographedOptions, path: &Path, cameras: &[Camera], tracks: &mut [Track]) {
    let share = if options.wrong == WrongKind::Clean { 0.0 } else { options.wrong_share };
    let mut rng = Stream::Wrong.of(options.seed);
    let mut order: Vec<usize> = (0..tracks.len()).collect();
    order.shuffle(&mut rng);
    order.truncate((share * tracks.len() as f64).round() as usize);
    let mut spoil = Spoil { options, cameras, rng };
    match options.wrong {
        WrongKind::Clean => {}
        WrongKind::Permuted => spoil.permute(tracks, &order),
        WrongKind::Slid => order.iter().for_each(|&track| spoil.slide(&mut tracks[track])),
        WrongKind::DriftingTracks => order.iter().for_each(|&track| spoil.drift(&mut tracks[track])),
        WrongKind::Static => order.iter().for_each(|&track| spoil.hold(&mut tracks[track])),
        WrongKind::SecondBody => spoil.move_with_body(path, tracks, &order),
        WrongKind::Repeated => spoil.repeat(tracks, &order),
        WrongKind::NearDuplicates => spoil.duplicate(tracks, &order),
        WrongKind::WrongLink => order.iter().for_each(|&track| spoil.link(&mut tracks[track])),
    }
}

/// What the kinds share.
struct Spoil<'a> {
    options: &'a PhotographedOptions,
    cameras: &'a [Camera],
    rng: ChaCha8Rng,
}

impl Spoil<'_> {
    fn border_px(&self) -> f64 {
        border_px(self.options)
    }

    /// Exchanges the points of the wrong tracks in each view so that none keeps its own.
    fn permute(&mut self, tracks: &mut [Track], wrong: &[usize]) {
        for view in 0..self.cameras.len() {
            let here = |&track: &usize| {
                let place = tracks[track].seen.iter().position(|seen| seen.view == view)?;
                Some((track, place))
            };
            let mut here: Vec<(usize, usize)> = wrong.iter().filter_map(here).collect();
            here.shuffle(&mut self.rng);
            let images: Vec<[f64; 2]> = here.iter().map(|&(track, place)| tracks[track].seen[place].image).collect();
            for (k, &(track, place)) in here.iter().enumerate() {
                // Few would become right tracks of each other's points.
                let image = if here.len() > 3 { images[(k + 1) % here.len()] } else { self.anywhere() };
                let seen = &mut tracks[track].seen[place];
                *seen = seen.moved(image);
            }
        }
    }

    fn anywhere(&mut self) -> [f64; 2] {
        points::pixel(self.border_px(), &mut self.rng)
    }

    /// The first wrong one of so many observations: one or two are right, as the track starts.
    fn start(&mut self, count: usize) -> usize {
        self.rng.random_range(1..count)
    }

    fn slide(&mut self, track: &mut Track) {
        let start = self.start(track.seen.len());
        let reference = &self.cameras[track.seen[0].view];
        for seen in &mut track.seen[start..] {
            let camera = &self.cameras[seen.view];
            let slid = slide(reference, camera, &track.point, &mut self.rng).map(|[x, y, _]| [x, y]);
            let inside =
                slid.filter(|&image| is_off(image, seen.image) && points::is_within(image, border_px(self.options)));
            *seen = seen.moved(inside.unwrap_or_else(|| points::pixel(border_px(self.options), &mut self.rng)));
        }
    }

    fn drift(&mut self, track: &mut Track) {
        let start = self.start(track.seen.len());
        let first = track.seen[start].view;
        let speed_px = self.rng.random_range(DRIFT_PX.0..DRIFT_PX.1);
        let direction = self.rng.random_range(0.0..TAU);
        let border_px = self.border_px();
        // What leaves the image is lost.
        let drifted = |seen: &Seen| {
            let away = speed_px * (1 + seen.view - first) as f64;
            let image = [seen.image[0] + away * direction.cos(), seen.image[1] + away * direction.sin()];
            points::is_within(image, border_px).then(|| seen.moved(image))
        };
        let mut seen = track.seen[..start].to_vec();
        seen.extend(track.seen[start..].iter().map_while(drifted));
        if seen.len() == start {
            seen.push(track.seen[start].moved(self.anywhere()));
        }
        track.seen = seen;
    }

    fn hold(&mut self, track: &mut Track) {
        let image = self.anywhere();
        track.seen.iter_mut().for_each(|seen| *seen = Seen { noise: STATIC_NOISE, ..seen.moved(image) });
    }

    fn move_with_body(&mut self, path: &Path, tracks: &mut [Track], wrong: &[usize]) {
        let motions = second_body::motions(self.options, path);
        for &track in wrong {
            let length = tracks[track].seen.len();
            let drawn = (0..BODY_DRAWS).find_map(|_| {
                let point = second_body::draw_point(&mut self.rng);
                let image = |(view, camera): (usize, &Camera)| {
                    let image = points::image(camera, &motions[view].apply(&point), border_px(self.options))?;
                    Some(Seen::right(view, image).moved(image))
                };
                let before: Vec<Seen> = self.cameras.iter().enumerate().filter_map(image).collect();
                let about = before.get(self.rng.random_range(0..before.len().max(1)))?.view;
                let seen = observed(self.options, before, about, length, &mut self.rng);
                (seen.len() >= 2).then_some(Track { point, second_body: true, seen })
            });
            match drawn {
                Some(drawn) => tracks[track] = drawn,
                None => self.permute(tracks, &[track]),
            }
        }
    }

    fn repeat(&mut self, tracks: &mut [Track], wrong: &[usize]) {
        let distance = self.rng.random_range(REPEATED_DISTANCE.0..REPEATED_DISTANCE.1);
        let direction = self.rng.random_range(0.0..TAU);
        let (cos, sin) = (direction.cos(), direction.sin());
        // Along the walls or the street; before all else across the view.
        let shift = distance
            * match self.options.motion {
                PhotographedMotion::Corridor => Vector3::z(),
                PhotographedMotion::Drive => Vector3::new(cos, 0.0, sin),
                _ => Vector3::new(cos, sin, 0.0),
            };
        for &track in wrong {
            let Track { point, seen, .. } = &mut tracks[track];
            let mut places: Vec<usize> = (0..seen.len()).collect();
            let count = ((seen.len() - 1) / 2).max(1);
            for &place in places.partial_shuffle(&mut self.rng, count).0.iter() {
                let camera = &self.cameras[seen[place].view];
                let own = seen[place].image;
                let copy = NEIGHBOURS.iter().find_map(|&copies| {
                    let image = points::image(camera, &(*point + shift * copies), border_px(self.options))?;
                    is_off(image, own).then_some(image)
                });
                let image = copy.unwrap_or_else(|| points::pixel(border_px(self.options), &mut self.rng));
                seen[place] = seen[place].moved(image);
            }
        }
    }

    fn duplicate(&mut self, tracks: &mut [Track], wrong: &[usize]) {
        let originals: Vec<usize> = wrong.iter().copied().take(ORIGINALS).collect();
        self.permute(tracks, &originals);
        for (k, &track) in wrong.iter().enumerate().skip(ORIGINALS) {
            let seen = tracks[originals[k % ORIGINALS]].seen.clone();
            tracks[track].seen = seen;
            for seen in &mut tracks[track].seen {
                let off = std::array::from_fn(|_| self.rng.random_range(-COPIED_WITHIN_PX..COPIED_WITHIN_PX));
                let [x, y]: [f64; 2] = off;
                // About the exact place: the noise is the original's alone.
                *seen = Seen { noise: 0.0, ..seen.moved([seen.image[0] + x, seen.image[1] + y]) };
            }
        }
    }

    /// Goes over to another point; the track's own is then the one that it shows more often, the first of equals.
    fn link(&mut self, track: &mut Track) {
        let count = track.seen.len();
        // Both pieces can be verified where there are enough views.
        let least = VERIFIABLE.min(count / 2).max(1);
        let cut = self.rng.random_range(least..=count - least);
        let views: Vec<usize> = track.seen[cut..].iter().map(|seen| seen.view).collect();
        let border_px = self.border_px();
        let other = (0..LINK_DRAWS).find_map(|_| {
            let about = &self.cameras[views[views.len() / 2]];
            let point = points::draw(self.options, about, border_px, &mut self.rng)?;
            let images = views.iter().map(|&view| points::image(&self.cameras[view], &point, border_px));
            Some((point, images.collect::<Option<Vec<_>>>()?))
        });
        let Some((point, images)) = other else {
            for k in cut..count {
                track.seen[k] = track.seen[k].moved(self.anywhere());
            }
            return;
        };
        let keeps_first = 2 * cut >= count;
        for (k, seen) in track.seen.iter_mut().enumerate() {
            let second = k >= cut;
            let image = if second { images[k - cut] } else { seen.image };
            let right = second != keeps_first;
            *seen = Seen { image, right, of_other: !right, ..*seen };
        }
        if !keeps_first {
            track.point = point;
        }
    }
}

/// Whether one place is far from another.
fn is_off(image: [f64; 2], from: [f64; 2]) -> bool {
    (image[0] - from[0]).hypot(image[1] - from[1]) >= LEAST_OFF_PX
}
