//! What every batch keeps to, that labels are true to the geometry, and that all there shall be occurs.

use std::collections::HashSet;

use rand::Rng;

use super::contamination::Kind;
use super::holes::{Holes, LEAST_IN_VIEW};
use super::motion::{MIN_DEPTH, Motion};
use super::*;
use crate::synthetic::scene::{self, NoiseKind, OutlierKind, Shape};

/// Batches of the tests that look at many: enough for rare things to occur, each of some ten scenes.
const BATCHES: u64 = 200;

/// The generator of a batch, as [`batch`] has it.
fn rng(number: u64) -> ChaCha8Rng {
    let mut rng = ChaCha8Rng::seed_from_u64(1);
    rng.set_stream(number);
    rng
}

/// Drafts of many batches, a few of each, so that large and small ones count alike.
fn drafts(numbers: std::ops::Range<u64>) -> impl Iterator<Item = (u64, Plan, Draft)> {
    numbers.flat_map(|number| {
        let mut rng = rng(number);
        let plan = Plan::draw(&mut rng);
        (0..3).map(move |_| (number, plan.clone(), Draft::draw(&plan, &mut rng))).collect::<Vec<_>>()
    })
}

#[test]
fn a_seed_and_a_number_give_the_same_lessons_and_others_give_others() {
    let scenes = batch(5, 3);
    batch(5, 4);
    assert_eq!(scenes, batch(5, 3));
    assert_ne!(scenes, batch(5, 4));
    assert_ne!(scenes, batch(6, 3));
    assert!(scenes.windows(2).all(|pair| pair[0] != pair[1]));
}

#[test]
fn every_lesson_has_its_size_its_minimal_counts_and_labels_that_agree() {
    for number in 0..BATCHES {
        let scenes = batch(1, number);
        let (views, tracks) = (scenes[0].views, scenes[0].tracks);
        assert!((4..=20).contains(&views) && (50..=500).contains(&tracks), "batch {number}: {views} x {tracks}");
        assert!((2..=24).contains(&scenes.len()), "batch {number}: {} scenes", scenes.len());
        let observations = scenes.len() * views * tracks;
        assert!(observations <= 16_000 || scenes.len() == 2, "batch {number}: {observations} observations");
        for scene in &scenes {
            assert_eq!((scene.views, scene.tracks), (views, tracks), "batch {number}");
            assert_eq!((scene.points.len(), scene.inlier.len()), (views * tracks, tracks));
            check(scene, number);
        }
    }
}

fn check(scene: &TrainingScene, number: u64) {
    let TrainingScene { views, tracks, points, visible, right, inlier } = scene;
    assert!(points.iter().flatten().all(|x| x.is_finite()), "batch {number}");
    assert!(points.iter().zip(visible).all(|(point, &seen)| seen || *point == [0.0; 2]), "batch {number}");
    assert!(right.iter().zip(visible).all(|(&right, &seen)| seen || !right), "batch {number}");
    for view in visible.chunks(*tracks) {
        let seen = view.iter().filter(|&&seen| seen).count();
        assert!(seen >= LEAST_IN_VIEW, "batch {number}: a view of {seen} observations");
    }
    for track in 0..*tracks {
        let count = |of: &[bool]| (0..*views).filter(|view| of[view * tracks + track]).count();
        let (seen, right) = (count(visible), count(right));
        assert!(seen >= 3, "batch {number}: {seen} observations of track {track}");
        assert!(right == 0 || right >= LEAST_RIGHT_IN_TRACK, "batch {number}: {right} right ones of track {track}");
        assert_eq!(inlier[track], right == seen, "batch {number}, track {track}");
    }
    let inliers = inlier.iter().filter(|&&inlier| inlier).count();
    assert!(inliers >= 4, "batch {number}: {inliers} inlier tracks");
}

/// The largest distance between a track's right observations and the images of the world point that fits them best,
/// and the smallest of its wrong ones, in standard deviations of the noise; images are computed anew from points and
/// poses, and which point it is, is not asked.
fn distances(draft: &Draft, scene: &TrainingScene, track: usize) -> (f64, f64) {
    let mut best = (f64::INFINITY, f64::INFINITY);
    for point in &draft.world.points {
        let (mut right, mut wrong) = (0.0f64, f64::INFINITY);
        for (view, pose) in draft.poses.iter().enumerate() {
            let k = view * scene.tracks + track;
            let seen = pose.rotation * point + pose.translation;
            let [x, y] = scene.points[k];
            let off = (draft.world.focal * seen.x / seen.z - x).hypot(draft.world.focal * seen.y / seen.z - y);
            match (scene.right[k], scene.visible[k]) {
                (true, _) => right = right.max(off / draft.noise),
                (false, true) => wrong = wrong.min(off / draft.noise),
                (false, false) => {}
            }
            if right > best.0 {
                break;
            }
        }
        if right < best.0 {
            best = (right, wrong);
        }
    }
    best
}

#[test]
fn right_observations_are_of_one_point_of_the_world_and_wrong_ones_are_not() {
    let (mut right_tracks, mut mixed, mut near) = (0usize, 0usize, 0usize);
    for (number, _, draft) in drafts(0..60) {
        let scene = draft.clone().finish(&mut rng(1_000 + number));
        let shows_its_point = |track: &usize| scene.right.iter().skip(*track).step_by(scene.tracks).any(|&right| right);
        for track in (0..scene.tracks).filter(shows_its_point) {
            let (right, wrong) = distances(&draft, &scene, track);
            // A Rayleigh variable is beyond 6 once in 10^8.
            assert!(right < 6.0, "batch {number}, track {track}: {right} deviations off, {:?}", draft.recipe);
            right_tracks += 1;
            if wrong.is_finite() {
                mixed += 1;
                near += usize::from(wrong < 1.0);
            }
        }
    }
    assert!(right_tracks > 2_000 && mixed > 500, "{right_tracks} tracks, {mixed} of them mixed");
    assert!(near * 50 < mixed, "{near} of {mixed} tracks have a wrong observation that nothing tells from a right one");
}

#[test]
fn cameras_have_the_whole_world_in_front() {
    for (number, _, draft) in drafts(0..BATCHES) {
        for pose in &draft.poses {
            assert!(draft.world.points.iter().all(|point| pose.apply(point).z > MIN_DEPTH), "batch {number}");
            let off = pose.rotation * pose.rotation.transpose() - nalgebra::Matrix3::identity();
            assert!(off.norm() < 1e-12 && pose.rotation.determinant() > 0.0, "batch {number}: {}", pose.rotation);
        }
    }
}

#[test]
fn every_kind_of_lesson_occurs_as_often_as_it_shall() {
    let (mut kinds, mut motions, mut dominant) = (HashSet::new(), Vec::new(), 0);
    let (mut wrong, mut noise, mut focal): (Vec<f64>, Vec<f64>, Vec<f64>) = Default::default();
    let (mut scenes, mut real_like, mut paper_sized, mut chained) = (0, 0, 0, 0);
    let mut holes = [0; 3];
    for number in 0..BATCHES {
        let plan = Plan::draw(&mut rng(number));
        scenes += plan.scenes;
        real_like += if plan.real_like { plan.scenes } else { 0 };
        paper_sized += usize::from((plan.views, plan.tracks) == (10, 200));
        holes[match plan.holes {
            Holes::None => 0,
            Holes::Banded => 1,
            Holes::Random(_) => 2,
        }] += 1;
    }
    for (number, plan, draft) in drafts(0..BATCHES) {
        kinds.insert(draft.recipe.kind);
        motions.push(draft.path.motion);
        dominant += usize::from(draft.recipe.dominant);
        focal.push(draft.world.focal);
        noise.push(draft.noise);
        if plan.real_like {
            chained += usize::from(draft.recipe.kind == Kind::Chained);
            assert!(draft.noise <= 0.003, "batch {number}");
        } else {
            let scene = draft.finish(&mut rng(number));
            let inliers = scene.inlier.iter().filter(|&&inlier| inlier).count();
            wrong.push(1.0 - inliers as f64 / scene.tracks as f64);
        }
    }
    assert_eq!(kinds.len(), 10, "{kinds:?}");
    assert!((1..=12).contains(&dominant), "{dominant}");
    for motion in [Motion::General, Motion::Orbit, Motion::Smooth, Motion::Forward] {
        assert!(motions.iter().filter(|&&other| other == motion).count() > 20, "{motion:?}");
    }
    let spans = |of: &[f64], low: f64, high: f64| of.iter().any(|&x| x < low) && of.iter().any(|&x| x > high);
    assert!(spans(&wrong, 0.4, 0.975), "{wrong:?}");
    assert!(spans(&noise, 1e-4, 0.025), "{noise:?}");
    assert!(spans(&focal, 0.4, 2.5), "{focal:?}");
    let near = |count: usize, of: usize, share: f64, off: f64| (count as f64 / of as f64 - share).abs() < off;
    assert!(near(real_like, scenes, 0.25, 0.07), "{real_like} of {scenes} scenes");
    assert!(near(paper_sized, BATCHES as usize, 0.3, 0.1), "{paper_sized} batches");
    assert!(near(chained, motions.len(), 0.6 * 0.32, 0.06), "{chained} chains of real matching");
    assert!(holes.iter().all(|&count| count > 15) && holes[0] > holes[2], "{holes:?}");
}

#[test]
fn the_product_s_scenes_are_among_the_lessons_with_all_that_they_can_be() {
    let mut rng = rng(0);
    let plan = Plan { views: 10, tracks: 50, scenes: 4, holes: Holes::None, real_like: false };
    let count = (0..1_000).filter(|_| plan.draws_product_scene(&mut rng)).count();
    assert!((250..350).contains(&count), "{count}");
    for other in [Plan { holes: Holes::Banded, ..plan.clone() }, Plan { real_like: true, ..plan.clone() }] {
        assert!((0..100).all(|_| !other.draws_product_scene(&mut rng)), "{other:?}");
    }
    let options: Vec<_> = (0..500).map(|_| product::options(rng.random_range(4..=20), 50, &mut rng)).collect();
    for option in &options {
        assert_eq!(option.validate(), Ok(()), "{option:?}");
        let shifted = if option.wrong_views == 0 { option.views / 2 } else { option.wrong_views };
        let share = option.outliers * shifted as f64 / option.views as f64;
        assert!(option.outlier_kind != OutlierKind::Repeated || share < 0.41, "{option:?}");
    }
    let occurs = |what: &dyn Fn(&scene::SceneOptions) -> bool| options.iter().filter(|&o| what(o)).count() > 10;
    use scene::Motion::{Forward, General, Orbit, PureRotation, PureTranslation, Turntable};
    for motion in [General, Orbit, Turntable, PureTranslation, Forward, PureRotation] {
        assert!(occurs(&|o| o.motion == motion), "{motion:?}");
    }
    for kind in [OutlierKind::Permuted, OutlierKind::Uniform, OutlierKind::Slid, OutlierKind::Repeated] {
        assert!(occurs(&|o| o.outlier_kind == kind && o.wrong_views == 0), "{kind:?}");
        assert!(occurs(&|o| o.outlier_kind == kind && o.wrong_views > 0), "{kind:?}");
    }
    for kind in [NoiseKind::Gaussian, NoiseKind::Laplace, NoiseKind::Heavy, NoiseKind::Uniform] {
        assert!(occurs(&|o| o.noise_kind == kind), "{kind:?}");
    }
    assert!(occurs(&|o| o.shape == Shape::Plane) && occurs(&|o| o.second_motion > 0.0));
    assert!(occurs(&|o| o.radial_k1 < 0.0) && occurs(&|o| o.zoom > 0.0) && occurs(&|o| o.principal_point[1] != 0.0));
}

#[test]
fn nearly_all_of_the_product_s_options_make_lessons() {
    let mut rng = rng(0);
    let mut made = 0;
    for number in 0..100 {
        let Some(scene) = product::draw(10, 60, &mut rng) else { continue };
        check(&scene, number);
        made += 1;
    }
    assert!(made > 90, "{made} of 100");
}

#[test]
fn groups_that_agree_in_all_views_are_smaller_than_the_right_tracks() {
    let mut found = 0;
    for (number, _, draft) in drafts(0..BATCHES) {
        let Draft { recipe, .. } = draft;
        if recipe.dominant || !matches!(recipe.kind, Kind::SecondMotion | Kind::Shifted | Kind::Static | Kind::Clusters)
        {
            continue;
        }
        found += 1;
        let right =
            (0..draft.tracks).filter(|&track| of_track(&draft.image, &draft.exact, draft.tracks, track)).count();
        // What is permuted shows points of other tracks.
        let grouped = (0..draft.tracks).filter(|&track| shows_no_point(&draft, track)).count();
        assert!(grouped < right, "batch {number}: {grouped} of {recipe:?} and {right} right tracks");
    }
    assert!(found > 50, "{found}");
}

/// Whether a track shows its own point throughout.
fn of_track(image: &[[f64; 2]], exact: &[[f64; 2]], tracks: usize, track: usize) -> bool {
    (track..image.len()).step_by(tracks).all(|k| image[k] == exact[k])
}

/// Whether a track shows, in some view, what is no point's image there.
fn shows_no_point(draft: &Draft, track: usize) -> bool {
    let views = draft.image.chunks(draft.tracks).zip(draft.exact.chunks(draft.tracks));
    views.into_iter().any(|(image, exact)| !exact.contains(&image[track]))
}
