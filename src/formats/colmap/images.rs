//! Cameras and images as COLMAP's files list them, and the input that they make together with tracks.

use std::collections::{BTreeMap, HashMap, HashSet};
use std::path::Path;

use super::FIRST_PIXEL;
use super::cameras::Camera;
use crate::domain::{RawInput, View, counted};
use crate::formats::input::LabelledInput;
use crate::formats::label::{Label, dense};

/// What COLMAP's files say of an image beside its tracks.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct ColmapImage {
    pub id: u32,
    /// Name of its camera's model; `None`: one that the solver does not fit.
    pub camera_model: Option<&'static str>,
    /// Of a database whose every frame is one image; `None`: of other files, and where a rig takes several.
    pub frame: Option<Frame>,
    /// Every keypoint in COLMAP's order and pixels, of a track or not.
    pub keypoints: Vec<[f32; 2]>,
}

/// Ids of the frame and the rig of an image.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Frame {
    pub id: u32,
    pub rig: u32,
}

/// Cameras by id, and images in the order of the file.
#[derive(Debug, Default)]
pub(super) struct Images {
    cameras: BTreeMap<u32, Camera>,
    images: Vec<Image>,
    by_id: HashMap<u32, u32>,
    names: HashSet<Label>,
    /// By image id.
    frames: HashMap<u32, Frame>,
}

#[derive(Debug)]
struct Image {
    id: u32,
    name: Label,
    camera: u32,
    keypoints: Vec<[f32; 2]>,
}

/// One keypoint of a track.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Observation {
    /// Position of the image in the file.
    pub image: u32,
    /// Position of the keypoint in the image.
    pub keypoint: u32,
    pub track: u64,
    /// In COLMAP's pixels.
    pub x: f64,
    pub y: f64,
    /// Line of the file; 0 where it has none.
    pub line: u64,
}

impl Images {
    pub fn add_camera(&mut self, id: u32, camera: Camera) -> Result<(), String> {
        match self.cameras.insert(id, camera) {
            None => Ok(()),
            Some(_) => Err("is there a second time".into()),
        }
    }

    /// Adds an image; returns its position.
    pub fn add_image(&mut self, id: u32, name: &str, camera: u32) -> Result<u32, String> {
        let name = Label::name(name)?;
        if !self.cameras.contains_key(&camera) {
            return Err(format!("is of camera {camera}, which is not among the cameras"));
        }
        if !self.names.insert(name.clone()) {
            return Err(format!("the name {name} is there a second time"));
        }
        // An image takes some bytes of a file, more than 2^32 of them no file.
        let position = self.images.len() as u32;
        if self.by_id.insert(id, position).is_some() {
            return Err("is there a second time".into());
        }
        self.images.push(Image { id, name, camera, keypoints: Vec::new() });
        Ok(position)
    }

    /// Adds the next keypoint of an image, of a track or not; returns its index.
    pub fn add_keypoint(&mut self, image: u32, x: f64, y: f64) -> u32 {
        let keypoints = &mut self.images[image as usize].keypoints;
        keypoints.push([x as f32, y as f32]);
        // A keypoint takes some bytes of a file, more than 2^32 of them no image.
        (keypoints.len() - 1) as u32
    }

    /// Every keypoint of an image.
    pub fn set_keypoints(&mut self, image: u32, keypoints: Vec<[f32; 2]>) {
        self.images[image as usize].keypoints = keypoints;
    }

    /// The frame of each image, by image id.
    pub fn set_frames(&mut self, frames: HashMap<u32, Frame>) {
        self.frames = frames;
    }

    pub fn len(&self) -> usize {
        self.images.len()
    }

    /// Position of the image of this id.
    pub fn position(&self, id: u32) -> Option<u32> {
        self.by_id.get(&id).copied()
    }

    /// The view of each image, and the image of each view: views are images in the order of their names.
    pub fn views(&self) -> (Vec<u32>, Vec<u32>) {
        let names: Vec<Label> = self.images.iter().map(|image| image.name.clone()).collect();
        let (_, view_of) = dense(&names);
        let mut order: Vec<u32> = (0..self.images.len() as u32).collect();
        order.sort_unstable_by_key(|&image| view_of[image as usize]);
        (view_of, order)
    }

    /// The input; its views are the images in the order of their names, each with its camera as group.
    ///
    /// A track keeps one observation of each image, the one that comes first; a note counts the others.
    pub fn into_labelled(
        mut self,
        mut observations: Vec<Observation>,
        path: &Path,
        notes: Vec<String>,
    ) -> LabelledInput {
        let mut notes = notes;
        let repeated = drop_repeated(&mut observations);
        if repeated > 0 {
            let left_out = counted(repeated, "observation");
            notes.push(format!("left out {left_out} beyond the first of a track in one image"));
        }
        notes.extend(self.foreign_cameras());
        let (view_of, order) = self.views();
        let order: Vec<usize> = order.into_iter().map(|image| image as usize).collect();
        let view_labels = order.iter().map(|&image| self.images[image].name.clone()).collect();
        let track_ids: Vec<u64> = observations.iter().map(|observation| observation.track).collect();
        let (track_labels, track) = dense(&track_ids);
        let has_lines = observations.iter().any(|observation| observation.line > 0);
        LabelledInput {
            raw: RawInput {
                views: order.iter().map(|&image| self.view(image)).collect(),
                track_count: track_labels.len(),
                view: observations.iter().map(|observation| view_of[observation.image as usize]).collect(),
                track,
                x: observations.iter().map(|observation| observation.x - FIRST_PIXEL).collect(),
                y: observations.iter().map(|observation| observation.y - FIRST_PIXEL).collect(),
                depth: Vec::new(),
                sigma: Vec::new(),
            },
            view_labels,
            track_labels: track_labels.into_iter().map(Label::Number).collect(),
            lines: if has_lines {
                observations.iter().map(|observation| observation.line).collect()
            } else {
                Vec::new()
            },
            colmap_images: order.iter().map(|&image| self.colmap_image(image)).collect(),
            keypoints: observations.iter().map(|observation| observation.keypoint).collect(),
            notes,
            path: path.into(),
            ..LabelledInput::default()
        }
    }

    fn view(&self, image: usize) -> View {
        let id = self.images[image].camera;
        // Checked when the image was added.
        let camera = self.cameras.get(&id);
        View {
            name: None,
            size: camera.map(|camera| camera.size),
            camera_group: id,
            focal_prior: camera.and_then(|camera| camera.focal_prior),
        }
    }

    /// Takes what is kept of an image.
    fn colmap_image(&mut self, image: usize) -> ColmapImage {
        let Image { id, camera, ref mut keypoints, .. } = self.images[image];
        let model = self.cameras.get(&camera).filter(|camera| !camera.is_foreign()).and_then(|camera| camera.model);
        ColmapImage {
            id,
            camera_model: model.map(|model| model.name),
            frame: self.frames.get(&id).copied(),
            keypoints: std::mem::take(keypoints),
        }
    }

    /// A note on cameras of models that the solver does not fit.
    fn foreign_cameras(&self) -> Option<String> {
        let used: HashSet<u32> = self.images.iter().map(|image| image.camera).collect();
        let foreign = self.cameras.iter().find(|(id, camera)| used.contains(id) && camera.is_foreign())?;
        let name = foreign.1.model.map_or("an unknown model", |model| model.name);
        Some(format!(
            "camera {} is of COLMAP's model {name}; its images are solved as those of a perspective lens with \
             radial and tangential distortion or of a fisheye with radial distortion",
            foreign.0
        ))
    }
}

/// Keeps the first observation of each track in each image; returns how many were dropped.
fn drop_repeated(observations: &mut Vec<Observation>) -> usize {
    let mut order: Vec<u32> = (0..observations.len() as u32).collect();
    let key = |k: u32| (observations[k as usize].track, observations[k as usize].image);
    order.sort_unstable_by_key(|&k| (key(k), k));
    let mut repeated = vec![false; observations.len()];
    for pair in order.windows(2) {
        repeated[pair[1] as usize] = key(pair[0]) == key(pair[1]);
    }
    let mut place = 0;
    observations.retain(|_| {
        place += 1;
        !repeated[place - 1]
    });
    repeated.iter().filter(|&&repeated| repeated).count()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::domain::Limits;
    use crate::formats::colmap::cameras::Model;

    #[test]
    fn views_are_images_by_name_with_the_size_and_group_of_their_cameras() {
        let mut images = Images::default();
        for (id, width) in [(4, 640), (2, 320)] {
            let camera = Camera::new(Model::of_name("PINHOLE"), width, 200).expect("a size").knowing(Some(500.0));
            images.add_camera(id, camera).expect("new");
        }
        assert_eq!(images.add_image(7, "b", 4), Ok(0));
        assert_eq!(images.add_image(3, "a", 2), Ok(1));
        assert!(images.add_image(3, "c", 2).is_err() && images.add_image(9, "a", 2).is_err());
        assert!(images.add_image(9, "d", 1).expect_err("no camera 1").contains("camera 1"));
        for (image, x) in [(0, 1.0), (1, 9.0), (1, 2.0), (0, 3.0), (0, 4.0)] {
            images.add_keypoint(image, x, 1.5);
        }
        let at = |image, keypoint, track, x| Observation { image, keypoint, track, x, y: 1.5, line: 0 };
        let seen = vec![at(0, 0, 11, 1.0), at(1, 1, 11, 2.0), at(0, 1, 11, 3.0), at(0, 2, 5, 4.0)];
        let input = images.into_labelled(seen, Path::new("m"), Vec::new());
        assert_eq!(input.view_labels, [Label::Name("a".into()), Label::Name("b".into())]);
        assert_eq!((input.colmap_images[0].id, input.colmap_images[1].id, &input.raw.view[..]), (3, 7, &[1, 0, 1][..]));
        assert_eq!((&input.raw.x[..], input.raw.y[0]), (&[0.5, 1.5, 3.5][..], 1.0));
        assert_eq!(input.keypoints, [0, 1, 2]);
        let images = &input.colmap_images;
        assert_eq!(images[0].keypoints, [[9.0, 1.5], [2.0, 1.5]]);
        assert_eq!(images[1].keypoints, [[1.0, 1.5], [3.0, 1.5], [4.0, 1.5]]);
        assert_eq!((images[0].camera_model, images[0].frame), (Some("PINHOLE"), None));
        let view = &input.raw.views[0];
        assert_eq!((view.camera_group, view.size.map(|size| size.width_px)), (2, Some(320)));
        assert_eq!(view.focal_prior.map(|prior| prior.focal_px), Some(500.0));
        assert_eq!(input.notes.len(), 1, "{:?}", input.notes);
        assert!(input.notes[0].starts_with("left out 1 observation beyond"));
        input.check(&Limits::default()).expect("valid");
    }
}
