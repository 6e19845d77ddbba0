//! Second structures of a result.

use super::enums::{Twin, optional_to_wire};
use super::result::rows;
use super::tracks::{in_rising_order, three};
use crate::domain::Violation;
use crate::domain::second_structure::{SecondStructure, SecondStructureKind, StructurePoint, StructurePose};
use crate::rpc::proto;

pub fn to_wire(structure: &SecondStructure) -> proto::SecondStructure {
    let pose = |pose: &StructurePose| proto::StructurePose {
        view_index: pose.view,
        rotation: pose.rotation.iter().flatten().copied().collect(),
        translation: pose.translation.to_vec(),
    };
    let point =
        |point: &StructurePoint| proto::StructurePoint { track_index: point.track, point: point.point.to_vec() };
    proto::SecondStructure {
        number: structure.number,
        kind: optional_to_wire(structure.kind),
        poses: structure.poses.iter().map(pose).collect(),
        points: structure.points.iter().map(point).collect(),
    }
}

/// Checks the structures against the numbers of all views and tracks.
///
/// # Errors
/// A violation that names the field: numbers do not rise by one from 1, an index is not in rising order or out of
/// range, or a matrix or vector has another length.
pub fn from_wire(
    structures: &[proto::SecondStructure],
    view_count: usize,
    track_count: usize,
) -> Result<Vec<SecondStructure>, Violation> {
    let structure = |(index, structure): (usize, &proto::SecondStructure)| {
        let proto::SecondStructure { number, kind, ref poses, ref points } = *structure;
        if number as usize != index + 1 {
            let what = format!("{number} instead of {}", index + 1);
            return Err(Violation::at("second_structures", index, what).within("number"));
        }
        let within = |list: &str| format!("second_structures[{index}].{list}");
        Ok(SecondStructure {
            number,
            kind: SecondStructureKind::known(kind),
            poses: poses_from_wire(poses, view_count, &within("poses"))?,
            points: points_from_wire(points, track_count, &within("points"))?,
        })
    };
    structures.iter().enumerate().map(structure).collect()
}

fn poses_from_wire(poses: &[proto::StructurePose], count: usize, field: &str) -> Result<Vec<StructurePose>, Violation> {
    let mut next = 0;
    let pose = |(index, pose): (usize, &proto::StructurePose)| {
        let wrong = |what| Violation::at(field, index, what);
        in_rising_order(pose.view_index, &mut next, count, "view").map_err(|what| wrong(what).within("view_index"))?;
        let rotation = rows(&pose.rotation)
            .ok()
            .flatten()
            .ok_or_else(|| wrong(format!("{} numbers instead of nine", pose.rotation.len())).within("rotation"))?;
        let translation = three(&pose.translation).map_err(|what| wrong(what).within("translation"))?;
        Ok(StructurePose { view: pose.view_index, rotation, translation })
    };
    poses.iter().enumerate().map(pose).collect()
}

fn points_from_wire(
    points: &[proto::StructurePoint],
    count: usize,
    field: &str,
) -> Result<Vec<StructurePoint>, Violation> {
    let mut next = 0;
    let point = |(index, found): (usize, &proto::StructurePoint)| {
        let wrong = |what| Violation::at(field, index, what);
        in_rising_order(found.track_index, &mut next, count, "track")
            .map_err(|what| wrong(what).within("track_index"))?;
        let point = three(&found.point).map_err(|what| wrong(what).within("point"))?;
        Ok(StructurePoint { track: found.track_index, point })
    };
    points.iter().enumerate().map(point).collect()
}
