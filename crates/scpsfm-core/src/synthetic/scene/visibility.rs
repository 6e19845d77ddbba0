//! Which views observe a track.

use rand::Rng;

use super::SceneOptions;
use super::camera::Camera;
use super::stream::Stream;

/// The views that observe each track: all, or those whose cameras are nearest to that of a random view.
pub fn draw_visibility(options: &SceneOptions, cameras: &[Camera]) -> Vec<Vec<usize>> {
    let all: Vec<usize> = (0..options.views).collect();
    if options.seen_views == 0 {
        return vec![all; options.tracks];
    }
    let neighbours = |camera: &Camera| {
        let distance = |view: usize| (cameras[view].pose.centre() - camera.pose.centre()).norm();
        let mut views = all.clone();
        views.sort_by(|&a, &b| distance(a).total_cmp(&distance(b)));
        views.truncate(options.seen_views);
        views
    };
    let neighbours: Vec<Vec<usize>> = cameras.iter().map(neighbours).collect();
    let mut rng = Stream::Visibility.of(options.seed);
    (0..options.tracks).map(|_| neighbours[rng.random_range(0..options.views)].clone()).collect()
}
