//! What tells one input from another.

use sha2::{Digest, Sha256};

use super::digest::Sha256Digest;
use super::input::RawInput;

impl RawInput {
    /// SHA-256 of what the whole input says, observations in the caller's order, as the API's
    /// `JobResult.input_content_sha256` lays it out. No part can be taken for another: all are of a fixed length but
    /// names, whose length goes before them, and 0, which stands for what is left out, is no valid size, focal length,
    /// sigma or depth.
    pub fn sha256(&self) -> Sha256Digest {
        let mut hash = Sha256::new();
        let count = |count: usize| (count as u64).to_le_bytes();
        hash.update(count(self.views.len()));
        for view in &self.views {
            let name = view.name.as_deref().unwrap_or_default();
            let (width_px, height_px) = view.size.map_or((0, 0), |size| (size.width_px, size.height_px));
            let (focal_px, sigma_log) = view.focal_prior.map_or((0.0, 0.0), |prior| (prior.focal_px, prior.sigma_log));
            hash.update(count(name.len()));
            hash.update(name);
            [width_px, height_px, view.camera_group].iter().for_each(|number| hash.update(number.to_le_bytes()));
            [focal_px, sigma_log].iter().for_each(|number| hash.update(number.to_le_bytes()));
        }
        hash.update(count(self.track_count));
        hash.update(count(self.x.len()));
        let given = |values: &[f64], k: usize| values.get(k).copied().unwrap_or(0.0);
        for (k, (((view, track), x), y)) in self.view.iter().zip(&self.track).zip(&self.x).zip(&self.y).enumerate() {
            [view, track].iter().for_each(|index| hash.update(index.to_le_bytes()));
            let numbers = [*x, *y, given(&self.sigma, k), given(&self.depth, k)];
            numbers.iter().for_each(|number| hash.update(number.to_le_bytes()));
        }
        Sha256Digest(hash.finalize().into())
    }
}

#[cfg(test)]
mod tests {
    use crate::domain::input::tests::raw;
    use crate::domain::{FocalPrior, ImageSize, Input, Limits, RawInput};

    /// An input with all that an input may have.
    fn full() -> RawInput {
        let mut full = raw();
        for (place, view) in full.views.iter_mut().enumerate() {
            view.name = Some(format!("{place}.jpg").into());
            view.size = Some(ImageSize { width_px: 640, height_px: 480 });
            view.focal_prior = Some(FocalPrior { focal_px: 500.0, sigma_log: 0.1 });
        }
        full.sigma = vec![0.5; full.x.len()];
        full.depth = vec![2.0; full.x.len()];
        full
    }

    #[test]
    fn every_part_of_an_input_counts() {
        type Change = fn(&mut RawInput);
        let changes: [(&str, Change); 21] = [
            ("another name", |raw| raw.views[0].name = Some("a.jpg".into())),
            ("no name", |raw| raw.views[0].name = None),
            ("a name that is longer at the cost of the next", |raw| {
                (raw.views[0].name, raw.views[1].name) = (Some("0.jpg1".into()), Some(".jpg".into()));
            }),
            ("a width", |raw| raw.views[1].size = Some(ImageSize { width_px: 641, height_px: 480 })),
            ("a height", |raw| raw.views[1].size = Some(ImageSize { width_px: 640, height_px: 481 })),
            ("width and height exchanged", |raw| {
                raw.views[1].size = Some(ImageSize { width_px: 480, height_px: 640 });
            }),
            ("no size", |raw| raw.views[1].size = None),
            ("a camera group", |raw| raw.views[1].camera_group = 1),
            ("a prior", |raw| raw.views[0].focal_prior = Some(FocalPrior { focal_px: 501.0, sigma_log: 0.1 })),
            ("its sigma", |raw| raw.views[0].focal_prior = Some(FocalPrior { focal_px: 500.0, sigma_log: 0.2 })),
            ("no prior", |raw| raw.views[0].focal_prior = None),
            ("a view more", |raw| raw.views.push(raw.views[0].clone())),
            ("a track more", |raw| raw.track_count += 1),
            ("a view index", |raw| raw.view[0] ^= 1),
            ("a track index", |raw| raw.track[0] ^= 1),
            ("an x", |raw| raw.x[3] += 0.5),
            ("a y", |raw| raw.y[3] += 0.5),
            ("a sigma", |raw| raw.sigma[3] += 0.5),
            ("a depth", |raw| raw.depth[3] += 0.5),
            ("no sigmas", |raw| raw.sigma.clear()),
            ("no depths", |raw| raw.depth.clear()),
        ];
        let mut digests = vec![("none", full().sha256())];
        for (what, change) in changes {
            let mut other = full();
            change(&mut other);
            let digest = other.sha256();
            if let Some((same, _)) = digests.iter().find(|(_, known)| *known == digest) {
                panic!("{what} gives the digest of {same}");
            }
            digests.push((what, digest));
        }
        // One column is not another.
        let sigmas = RawInput { depth: Vec::new(), ..full() };
        let depths = RawInput { sigma: Vec::new(), depth: sigmas.sigma.clone(), ..full() };
        assert_ne!(sigmas.sha256(), depths.sha256());
    }

    #[test]
    fn the_order_of_the_caller_counts() {
        let mut swapped = full();
        swapped.view.swap(0, 1);
        swapped.track.swap(0, 1);
        swapped.x.swap(0, 1);
        swapped.y.swap(0, 1);
        assert_ne!(swapped.sha256(), full().sha256());
        let checked = Input::new(swapped.clone(), &Limits::default(), "input").expect("valid");
        assert_eq!(checked.to_raw().sha256(), swapped.sha256(), "sorted inside, the caller's order outside");
    }

    #[test]
    fn the_digest_is_that_of_the_bytes_that_the_api_describes() {
        use crate::domain::View;
        use sha2::{Digest, Sha256};
        let size = ImageSize { width_px: 3, height_px: 2 };
        let named = View { name: Some("é".into()), size: Some(size), camera_group: 7, focal_prior: None };
        let raw = RawInput {
            views: vec![named, View::default()],
            track_count: 1,
            view: vec![1, 0],
            track: vec![0, 0],
            x: vec![1.0, 2.0],
            y: vec![-1.0, 0.5],
            depth: vec![4.0, 8.0],
            sigma: Vec::new(),
        };
        let mut bytes = Vec::new();
        let (long, short) = (|number: u64| number.to_le_bytes(), |number: u32| number.to_le_bytes());
        bytes.extend(long(2));
        bytes.extend(long(2));
        bytes.extend("é".as_bytes());
        for number in [3, 2, 7] {
            bytes.extend(short(number));
        }
        bytes.extend([0; 16]);
        bytes.extend(long(0));
        bytes.extend([0; 3 * 4 + 2 * 8]);
        bytes.extend(long(1));
        bytes.extend(long(2));
        for (view, numbers) in [(1, [1.0, -1.0, 0.0, 4.0]), (0, [2.0, 0.5, 0.0, 8.0_f64])] {
            bytes.extend(short(view));
            bytes.extend(short(0));
            bytes.extend(numbers.iter().flat_map(|number| number.to_le_bytes()));
        }
        assert_eq!(raw.sha256().0, <[u8; 32]>::from(Sha256::digest(&bytes)));
    }
}
