//! What tells one input from another: results list views, tracks and observations by their place in it alone.

use sha2::{Digest, Sha256};

use super::RawInput;

impl RawInput {
    /// SHA-256, hexadecimal, of what results refer to and are read by: sizes of the images, and view, track and pixels
    /// of every observation in the caller's order.
    pub fn sha256(&self) -> String {
        let mut hash = Sha256::new();
        let count = |count: usize| (count as u64).to_le_bytes();
        hash.update(count(self.views.len()));
        for view in &self.views {
            let size = view.size.map_or((0, 0), |size| (size.width_px, size.height_px));
            hash.update(size.0.to_le_bytes());
            hash.update(size.1.to_le_bytes());
        }
        hash.update(count(self.track_count));
        hash.update(count(self.x.len()));
        for (((view, track), x), y) in self.view.iter().zip(&self.track).zip(&self.x).zip(&self.y) {
            hash.update(view.to_le_bytes());
            hash.update(track.to_le_bytes());
            hash.update(x.to_le_bytes());
            hash.update(y.to_le_bytes());
        }
        hash.finalize().iter().map(|byte| format!("{byte:02x}")).collect()
    }
}

#[cfg(test)]
mod tests {
    use crate::domain::input::tests::raw;
    use crate::domain::{ImageSize, Input, Limits};

    #[test]
    fn the_order_the_points_and_the_sizes_count() {
        let sha256 = raw().sha256();
        let mut swapped = raw();
        swapped.view.swap(0, 1);
        swapped.track.swap(0, 1);
        swapped.x.swap(0, 1);
        swapped.y.swap(0, 1);
        let mut moved = raw();
        moved.x[3] += 0.5;
        let mut sized = raw();
        sized.views[1].size = Some(ImageSize { width_px: 640, height_px: 480 });
        for other in [&swapped, &moved, &sized] {
            assert_ne!(other.sha256(), sha256);
        }
        let checked = Input::new(swapped.clone(), &Limits::default(), "input").expect("valid");
        assert_eq!(checked.to_raw().sha256(), swapped.sha256(), "sorted inside, the caller's order outside");
    }
}
