//! Writing the rigs and frames of a sparse model (COLMAP, `reconstruction_io_{text,binary}.cc`), so that it goes
//! together with the database that its images came from.
//!
//! Without these files COLMAP numbers the frames of a model like its images and the rigs like its cameras. Where a
//! database numbers them otherwise, it then refuses to go on from the model.

use std::collections::BTreeMap;
use std::fmt::Write;

use super::Frame;
use super::write::{count, pose};
use crate::formats::metric::{Image, Model};

/// COLMAP's number of the kind of sensor that is a camera.
const CAMERA: i32 = 0;
const RIGS_TXT: &str = "# RIG_ID NUM_SENSORS REF_SENSOR_TYPE REF_SENSOR_ID\n";
const FRAMES_TXT: &str =
    "# FRAME_ID RIG_ID QW QX QY QZ TX TY TZ NUM_DATA_IDS DATA_IDS[] as SENSOR_TYPE SENSOR_ID DATA_ID\n";

/// Rigs and frames of a model, each rig one camera and each frame one image.
struct Frames<'a> {
    /// Camera id of each rig.
    rigs: BTreeMap<u32, u32>,
    /// With the id of the image's camera.
    frames: Vec<(Frame, u32, &'a Image)>,
}

impl<'a> Frames<'a> {
    /// `None` where an image has no frame of its own, or a rig several cameras: then COLMAP's own numbering stands.
    fn of(model: &'a Model) -> Option<Self> {
        let (mut rigs, mut rig_of_camera) = (BTreeMap::new(), BTreeMap::new());
        let mut frames = Vec::with_capacity(model.images.len());
        for image in &model.images {
            let (frame, camera) = (image.colmap_frame?, model.cameras[image.camera].id);
            let is_alone = *rigs.entry(frame.rig).or_insert(camera) == camera
                && *rig_of_camera.entry(camera).or_insert(frame.rig) == frame.rig;
            if !is_alone {
                return None;
            }
            frames.push((frame, camera, image));
        }
        Some(Self { rigs, frames })
    }
}

/// `rigs.bin` and `frames.bin`, where the images have frames of their own.
pub fn binary(model: &Model) -> Option<[Vec<u8>; 2]> {
    let Frames { rigs: cameras, frames: images } = Frames::of(model)?;
    let mut rigs = count(cameras.len());
    for (rig, camera) in cameras {
        // One sensor.
        rigs.extend([rig, 1].map(u32::to_le_bytes).as_flattened());
        rigs.extend(CAMERA.to_le_bytes());
        rigs.extend(camera.to_le_bytes());
    }
    let mut frames = count(images.len());
    for (frame, camera, image) in images {
        frames.extend([frame.id, frame.rig].map(u32::to_le_bytes).as_flattened());
        frames.extend(pose(image).map(f64::to_le_bytes).as_flattened());
        // One image.
        frames.extend(1u32.to_le_bytes());
        frames.extend(CAMERA.to_le_bytes());
        frames.extend(camera.to_le_bytes());
        frames.extend(u64::from(image.id).to_le_bytes());
    }
    Some([rigs, frames])
}

/// `rigs.txt` and `frames.txt`, where the images have frames of their own.
pub fn text(model: &Model) -> Option<[String; 2]> {
    let Frames { rigs: cameras, frames: images } = Frames::of(model)?;
    // Writing to a String cannot fail.
    let mut rigs = String::from(RIGS_TXT);
    for (rig, camera) in cameras {
        let _ = writeln!(rigs, "{rig} 1 CAMERA {camera}");
    }
    let mut frames = String::from(FRAMES_TXT);
    for (frame, camera, image) in images {
        let _ = write!(frames, "{} {}", frame.id, frame.rig);
        pose(image).iter().for_each(|value| _ = write!(frames, " {value}"));
        let _ = writeln!(frames, " 1 CAMERA {camera} {}", image.id);
    }
    Some([rigs, frames])
}
