//! What a result says of tracks and of their observations.

use crate::domain::result::{ObservationResults, TrackResults, TrackSplit, TwoViewTrack};
use crate::domain::{JoinedTracks, Joining, Violation};
use crate::rpc::proto;

/// Points are few among many tracks: they travel as indices and coordinates.
pub fn to_wire(tracks: &TrackResults) -> proto::TrackResults {
    let with_point = || tracks.point.iter().enumerate().filter_map(|(track, point)| Some((track, (*point)?)));
    proto::TrackResults {
        weights: tracks.weight.clone(),
        inliers: tracks.inlier.clone(),
        network_weights: tracks.network_weight.clone(),
        point_track_indices: with_point().map(|(track, _)| track as u32).collect(),
        points: with_point().flat_map(|(_, point)| point).collect(),
        point_parts: if tracks.part.is_empty() {
            Vec::new()
        } else {
            with_point().map(|(track, _)| tracks.part_of(track).unwrap_or(0)).collect()
        },
        second_structure_numbers: tracks.second_structure.clone(),
    }
}

/// Checks the tracks that two views see against the number of all tracks.
pub fn two_view_tracks_from_wire(found: &[proto::TwoViewTrack], count: usize) -> Result<Vec<TwoViewTrack>, Violation> {
    let mut next = 0;
    let track = |(index, found): (usize, &proto::TwoViewTrack)| {
        let proto::TwoViewTrack { track_index: track, weight, part, ref point } = *found;
        in_rising_order(track, &mut next, count, "track")
            .map_err(|what| Violation::at("two_view_tracks.track_index", index, what))?;
        let point = point_from_wire(point, "two_view_tracks.point", index)?;
        Ok(TwoViewTrack { track, weight, part, point })
    };
    found.iter().enumerate().map(track).collect()
}

/// Checks that an index is among the `count`, and from `next` on, which becomes the one after it; otherwise says so.
pub fn in_rising_order(index: u32, next: &mut usize, count: usize, what: &str) -> Result<(), String> {
    if !(*next..count).contains(&(index as usize)) {
        return Err(format!("{what} {index} is not in rising order within the {count} {what}s"));
    }
    *next = index as usize + 1;
    Ok(())
}

pub fn from_wire(tracks: proto::TrackResults) -> Result<TrackResults, Violation> {
    let count = tracks.weights.len();
    let is_of_all = |length: usize| length == 0 || length == count;
    let are_of_all = is_of_all(tracks.network_weights.len()) && is_of_all(tracks.second_structure_numbers.len());
    if tracks.inliers.len() != count || !are_of_all {
        return Err(Violation::of("tracks", format!("arrays of different lengths beside {count} weights")));
    }
    if tracks.points.len() != 3 * tracks.point_track_indices.len() {
        return Err(Violation::of(
            "tracks.points",
            format!("{} numbers for {} points", tracks.points.len(), tracks.point_track_indices.len()),
        ));
    }
    let part_count = tracks.point_parts.len();
    if part_count != 0 && part_count != tracks.point_track_indices.len() {
        let what = format!("{part_count} parts for {} points", tracks.point_track_indices.len());
        return Err(Violation::of("tracks.point_parts", what));
    }
    let mut point = vec![None; count];
    let mut part = if part_count == 0 { Vec::new() } else { vec![0; count] };
    for (index, (&track, xyz)) in tracks.point_track_indices.iter().zip(tracks.points.chunks_exact(3)).enumerate() {
        let slot = point.get_mut(track as usize).ok_or_else(|| {
            Violation::at("tracks.point_track_indices", index, format!("track {track} is outside the {count} tracks"))
        })?;
        *slot = Some([xyz[0], xyz[1], xyz[2]]);
        if let (Some(part), Some(&of)) = (part.get_mut(track as usize), tracks.point_parts.get(index)) {
            *part = of;
        }
    }
    let proto::TrackResults { weights, inliers, network_weights, second_structure_numbers, .. } = tracks;
    Ok(TrackResults {
        weight: weights,
        inlier: inliers,
        network_weight: network_weights,
        point,
        part,
        second_structure: second_structure_numbers,
    })
}

pub fn observations_to_wire(observations: &ObservationResults) -> proto::ObservationResults {
    proto::ObservationResults {
        inliers: observations.inlier.clone(),
        classified: observations.residual_px.iter().map(Option::is_some).collect(),
        residuals_px: observations.residual_px.iter().map(|residual| residual.unwrap_or(0.0)).collect(),
        weights: observations.weight.clone(),
        split_numbers: if observations.split.iter().any(|&split| split > 0) {
            observations.split.clone()
        } else {
            Vec::new()
        },
    }
}

pub fn split_to_wire(split: &TrackSplit) -> proto::TrackSplit {
    let TrackSplit { track, number, weight, point } = *split;
    proto::TrackSplit { track_index: track, number, weight, point: point.map_or_else(Vec::new, Vec::from) }
}

pub fn split_from_wire((index, split): (usize, &proto::TrackSplit)) -> Result<TrackSplit, Violation> {
    let point = point_from_wire(&split.point, "track_splits.point", index)?;
    Ok(TrackSplit { track: split.track_index, number: split.number, weight: split.weight, point })
}

pub fn two_view_track_to_wire(found: &TwoViewTrack) -> proto::TwoViewTrack {
    let TwoViewTrack { track, weight, part, point } = *found;
    proto::TwoViewTrack { track_index: track, weight, part, point: point.map_or_else(Vec::new, Vec::from) }
}

/// A point, or none at infinity.
fn point_from_wire(numbers: &[f64], field: &'static str, index: usize) -> Result<Option<[f64; 3]>, Violation> {
    if numbers.is_empty() {
        return Ok(None);
    }
    three(numbers).map(Some).map_err(|what| Violation::at(field, index, what))
}

/// Three numbers, or what is wrong with them.
pub fn three(numbers: &[f64]) -> Result<[f64; 3], String> {
    numbers.try_into().map_err(|_| format!("{} numbers instead of three", numbers.len()))
}

pub fn observations_from_wire(mut observations: proto::ObservationResults) -> Result<ObservationResults, Violation> {
    let count = observations.inliers.len();
    if observations.classified.len() != count || observations.residuals_px.len() != count {
        return Err(Violation::of("observations", "arrays of different lengths"));
    }
    let lengths = [("weights", observations.weights.len()), ("split_numbers", observations.split_numbers.len())];
    if let Some((name, length)) = lengths.into_iter().find(|(_, length)| ![0, count].contains(length)) {
        return Err(Violation::of(
            format!("observations.{name}"),
            format!("{length} entries for {count} observations"),
        ));
    }
    let residual_px = observations.classified.iter().zip(&observations.residuals_px);
    // Both are left out where they say nothing.
    observations.weights.resize(count, 0.0);
    observations.split_numbers.resize(count, 0);
    Ok(ObservationResults {
        residual_px: residual_px.map(|(&classified, &residual)| classified.then_some(residual)).collect(),
        weight: observations.weights,
        split: observations.split_numbers,
        inlier: observations.inliers,
    })
}

pub fn joined_tracks_to_wire(joined: &JoinedTracks) -> proto::JoinedTracks {
    proto::JoinedTracks {
        view_indices: joined.view.clone(),
        track_indices: joined.track.clone(),
        keypoint_indices: joined.joining.keypoint.clone(),
        match_count: joined.joining.match_count,
        cut_match_count: joined.joining.cut_match_count,
    }
}

pub fn joined_tracks_from_wire(joined: proto::JoinedTracks) -> Result<JoinedTracks, Violation> {
    let proto::JoinedTracks { view_indices, track_indices, keypoint_indices, match_count, cut_match_count } = joined;
    if view_indices.len() != keypoint_indices.len() || track_indices.len() != keypoint_indices.len() {
        return Err(Violation::of("joined_tracks", "arrays of different lengths"));
    }
    let joining = Joining { keypoint: keypoint_indices, match_count, cut_match_count };
    Ok(JoinedTracks { view: view_indices, track: track_indices, joining })
}
