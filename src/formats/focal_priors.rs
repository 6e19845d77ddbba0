//! Whether focal lengths that were given beforehand are in the units that they look like.

use crate::domain::{FocalPrior, RawInput, View};

/// Share of the longer image side below which a focal length in pixels is doubted: a perspective lens of this one sees
/// 157 degrees, and a fisheye's that sees 180 has three times as much. Millimetres are a hundredth.
const LEAST_FOCAL: f64 = 0.1;

/// Standard deviation of the logarithm above which a focal length says nothing: a factor of 2.7 either way.
const MOST_SIGMA_LOG: f64 = 1.0;

/// Says so where a focal length looks like millimetres, or its standard deviation like per cent.
pub(super) fn doubts(raw: &RawInput) -> Vec<String> {
    let priors = || raw.views.iter().filter_map(|view| Some((view, view.focal_prior?)));
    let extent_px = extent(&raw.x).max(extent(&raw.y));
    let short = priors().find_map(|(View { size, .. }, FocalPrior { focal_px, .. })| {
        let side_px = size.map_or(extent_px, |size| f64::from(size.width_px.max(size.height_px)));
        (focal_px < LEAST_FOCAL * side_px).then(|| {
            format!(
                "a focal length of {focal_px} px is less than a tenth of the image: is it in millimetres? In pixels it \
                 is the focal length in mm, divided by the width of the sensor in mm, times the width of the image in \
                 px; one that is equivalent to 35 mm film is divided by 36 mm"
            )
        })
    });
    let vague = priors().map(|(_, prior)| prior.sigma_log).find(|sigma_log| *sigma_log > MOST_SIGMA_LOG);
    let vague = vague.map(|sigma_log| {
        format!(
            "a focal length of sigma {sigma_log} says next to nothing: sigma is the standard deviation of its \
             logarithm, and .1 is 10 %"
        )
    });
    short.into_iter().chain(vague).collect()
}

/// From the least to the largest.
fn extent(values: &[f64]) -> f64 {
    let of = |(low, high): (f64, f64), value: &f64| (low.min(*value), high.max(*value));
    let (low, high) = values.iter().fold((f64::INFINITY, f64::NEG_INFINITY), of);
    high - low
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::domain::ImageSize;

    #[test]
    fn units_are_doubted_and_lenses_are_not() {
        let told = |focal_px, sigma_log, size| {
            let view = View { size, focal_prior: Some(FocalPrior { focal_px, sigma_log }), ..View::default() };
            let raw = RawInput { views: vec![view], x: vec![0.0, 900.0], y: vec![0.0, 700.0], ..RawInput::default() };
            doubts(&raw)
        };
        for size in [None, Some(ImageSize { width_px: 1000, height_px: 800 })] {
            let millimetres = told(28.0, 0.1, size);
            assert!(millimetres.len() == 1 && millimetres[0].contains("is it in millimetres?"), "{millimetres:?}");
            let per_cent = told(900.0, 10.0, size);
            assert!(per_cent.len() == 1 && per_cent[0].contains("of sigma 10 says next to nothing"), "{per_cent:?}");
            assert!(told(320.0, 1.0, size).is_empty(), "a fisheye");
            assert_eq!(told(28.0, 10.0, size).len(), 2);
        }
        assert!(doubts(&RawInput::default()).is_empty());
    }
}
