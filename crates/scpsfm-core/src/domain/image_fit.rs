//! Whether the points lie as in images of the sizes that were given. The calibration rests on the middle of the images:
//! where the points look like something else, a warning says what, and what to do.

use super::{ImageSize, Input, Warning, WarningCode};

options! {
    /// Thresholds of the suspicions. Shares are of the points in views whose size is known.
    pub struct ImageFitOptions {
        /// Points from which on it counts where all of them lie, or that none lies elsewhere. Of ten tracks anywhere in
        /// five images none is beyond the middle, in x or in y, once in a million; of one small object it may be so.
        least_points: usize = 50,
        /// Largest coordinate of points that are in no pixels: in units of the image they are within 1, in focal
        /// lengths within 2 up to 127 degrees of view. An image of 2 pixels shows nothing.
        normalized_within: f64 = 2.0,
        /// Least share of x and of y on either side of 0 of points that are measured from the image centre: about half
        /// of them are, and of points in an image none. A camera that travels may see most of its points below.
        centred_share: f64 = 0.1,
        /// Share of the points that may lie beyond an image, about (0, 0), whose centre they are measured from: a few
        /// wild ones. Of scenes that were made up, whose cameras see beyond all edges of their images, half do.
        centred_beyond: f64 = 0.01,
        /// Share of the points beyond the right or lower edge of their image, and none beyond the others, from which
        /// its size is suspect: that of a reduced copy leaves half of the points out, exchanged sides a fiftieth and
        /// more. Points of scenes that were made up lie beyond all edges.
        beyond_two_edges: f64 = 0.01,
        /// Distance from the middle of the image within which half of the points must lie, in the longer image side:
        /// within an image it is half a side at most, the paper's scenes, whose cameras see beyond their image, have .8
        /// of it, and a size that is three times too small shows.
        half_within: f64 = 1.0,
        /// How far beyond an edge a point may lie, in pixels: there are conventions that differ by half of one.
        edge_px: f64 = 1.0,
    }
}

/// How points lie in their images.
#[derive(Debug, Default)]
struct Layout {
    /// Of all views, and their largest coordinate.
    points: usize,
    largest: f64,
    /// Of the views whose size is known; the others count these.
    sized: usize,
    before_an_edge: usize,
    beyond_an_edge: usize,
    /// Beyond the middle, in x or in y.
    beyond_the_middle: usize,
    /// Farther from the middle than [`ImageFitOptions::half_within`].
    far: usize,
    /// Beyond an image about (0, 0).
    beyond_centred: usize,
    negative_x: usize,
    negative_y: usize,
}

impl Layout {
    fn new(input: &Input, options: &ImageFitOptions) -> Self {
        let mut layout = Self::default();
        for k in 0..input.observation_count() {
            let [x, y] = input.point_px(k);
            layout.points += 1;
            layout.largest = layout.largest.max(x.abs()).max(y.abs());
            let Some(size) = input.views()[input.view_of(k)].size else { continue };
            layout.add(x, y, size, options);
        }
        layout
    }

    fn add(&mut self, x: f64, y: f64, size: ImageSize, options: &ImageFitOptions) {
        let (width, height) = (f64::from(size.width_px), f64::from(size.height_px));
        let is_beyond = |right: f64, down: f64| x > right + options.edge_px || y > down + options.edge_px;
        let offset = (x - (width - 1.0) / 2.0).abs().max((y - (height - 1.0) / 2.0).abs());
        self.sized += 1;
        self.before_an_edge += usize::from(x.min(y) < -options.edge_px);
        self.beyond_an_edge += usize::from(is_beyond(width, height));
        self.beyond_the_middle += usize::from(is_beyond(width / 2.0, height / 2.0));
        self.far += usize::from(offset > options.half_within * width.max(height));
        let is_centred = x.abs() <= width / 2.0 + options.edge_px && y.abs() <= height / 2.0 + options.edge_px;
        self.beyond_centred += usize::from(!is_centred);
        self.negative_x += usize::from(x < 0.0);
        self.negative_y += usize::from(y < 0.0);
    }

    /// A count as a share of the points in views whose size is known; 0 without any.
    fn share(&self, count: usize) -> f64 {
        count as f64 / self.sized.max(1) as f64
    }

    fn is_normalized(&self, options: &ImageFitOptions) -> bool {
        self.points >= options.least_points && self.largest <= options.normalized_within
    }

    fn is_centred(&self, options: &ImageFitOptions) -> bool {
        let on_both_sides =
            |negative: usize| (options.centred_share..=1.0 - options.centred_share).contains(&self.share(negative));
        self.sized >= options.least_points
            && on_both_sides(self.negative_x)
            && on_both_sides(self.negative_y)
            && self.share(self.beyond_centred) <= options.centred_beyond
    }

    /// Points that fill an image from its upper left corner, and a larger one than the size that was given.
    fn is_of_larger_images(&self, options: &ImageFitOptions) -> bool {
        self.before_an_edge == 0 && self.share(self.beyond_an_edge) > options.beyond_two_edges
    }

    /// Points that no image of such a size could show.
    fn is_far_outside(&self) -> bool {
        self.share(self.far) > 0.5
    }

    /// Points in the upper left quarter.
    fn is_of_smaller_images(&self, options: &ImageFitOptions) -> bool {
        self.sized >= options.least_points && self.before_an_edge == 0 && self.beyond_the_middle == 0
    }
}

/// Whether a suspicion holds, and its words.
type Suspicion = (fn(&Layout, &ImageFitOptions) -> bool, fn(&Layout) -> String);

/// What points may be that are not pixels of images of the given sizes. The first that holds is told: of the later ones
/// some are true of it, too.
const SUSPICIONS: [Suspicion; 5] = [
    (Layout::is_normalized, |layout| {
        format!(
            "no coordinate is larger than {:.3}: these are no pixels. Multiply coordinates that were divided by the image \
             size by that size; multiply those in focal lengths by the focal length in pixels, and add the image centre",
            layout.largest
        )
    }),
    (Layout::is_centred, |layout| {
        format!(
            "{:.0} % of x and {:.0} % of y are negative, and all lie within half an image of (0, 0): were they measured \
             from the image centre? Add half the size, x + (width - 1) / 2 and y + (height - 1) / 2; where y points up, \
             take (height - 1) / 2 - y",
            100.0 * layout.share(layout.negative_x),
            100.0 * layout.share(layout.negative_y)
        )
    }),
    (Layout::is_of_larger_images, |layout| {
        format!(
            "{:.0} % of the points lie beyond the right or lower edge of their image and none beyond the others: is the \
             size that was given that of these images, and are width and height in their places?",
            100.0 * layout.share(layout.beyond_an_edge)
        )
    }),
    (
        |layout, _| layout.is_far_outside(),
        |_| {
            "half of the points lie farther from the middle of their image than it is long: is the size that was given that \
         of these images, or of a reduced copy?"
            .into()
        },
    ),
    (Layout::is_of_smaller_images, |_| {
        "all points lie in the upper left quarter of their image: is the size that was given that of these images, or \
         were the points measured in reduced copies? Give the size of the images in which they were measured"
            .into()
    }),
];

/// Says so where the points do not lie as in images of the sizes that were given.
pub fn suspicion(input: &Input, options: &ImageFitOptions) -> Option<Warning> {
    let layout = Layout::new(input, options);
    let (_, detail) = SUSPICIONS.iter().find(|(holds, _)| holds(&layout, options))?;
    Some(Warning::new(WarningCode::PointsOutsideImage, detail(&layout)))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::domain::{Limits, RawInput, View};

    const SIZE: ImageSize = ImageSize { width_px: 900, height_px: 600 };

    /// What is said of points that fill an image of [`SIZE`] as a grid, `rows` times as many, each where `place` has
    /// it.
    fn said(size: Option<ImageSize>, rows: u32, place: impl Fn(f64, f64) -> (f64, f64)) -> Option<String> {
        let count = 3 * 10 * rows;
        let points = (0..count).map(|k| {
            let (track, rows) = (k / 3, f64::from(rows));
            place((0.5 + f64::from(track % 10)) * 90.0, (0.5 + f64::from(track / 10)) * 600.0 / rows)
        });
        let (x, y) = points.unzip();
        let raw = RawInput {
            views: vec![View { size, ..View::default() }; 3],
            track_count: 10 * rows as usize,
            view: (0..count).map(|k| k % 3).collect(),
            track: (0..count).map(|k| k / 3).collect(),
            x,
            y,
            ..RawInput::default()
        };
        let input = Input::new(raw, &Limits::default(), "points").expect("valid");
        let warning = suspicion(&input, &ImageFitOptions::DEFAULT)?;
        assert_eq!(warning.code, WarningCode::PointsOutsideImage);
        Some(warning.detail)
    }

    /// Images of this size in place of those that hold the points.
    fn of_size(width_px: u32, height_px: u32) -> Option<String> {
        said(Some(ImageSize { width_px, height_px }), 4, |x, y| (x, y))
    }

    #[test]
    fn images_of_another_size_are_noticed() {
        let begins = |told: Option<String>, words: &str| {
            let told = told.expect(words);
            assert!(told.contains(words), "{words}: {told}");
        };
        begins(of_size(450, 300), "beyond the right or lower edge");
        begins(of_size(600, 900), "beyond the right or lower edge");
        begins(of_size(1800, 1200), "in the upper left quarter");
        begins(of_size(7200, 4800), "in the upper left quarter");
        begins(said(Some(SIZE), 4, |x, y| (5.0 * (x - 450.0), 5.0 * (y - 300.0))), "half of the points lie farther");
    }

    #[test]
    fn coordinates_from_the_centre_are_noticed() {
        let down = said(Some(SIZE), 4, |x, y| (x - 449.5, y - 299.5)).expect("centred");
        assert!(
            down.starts_with("50 % of x and 50 % of y are negative") && down.contains("Add half the size"),
            "{down}"
        );
        let up = said(Some(SIZE), 4, |x, y| (x - 449.5, 299.5 - y)).expect("centred");
        assert!(up.contains("where y points up"), "{up}");
        let below = said(Some(SIZE), 4, |x, y| (x - 449.5, 0.7 * (y - 120.0) - 60.0)).expect("mostly below");
        assert!(below.contains("were they measured from the image centre"), "{below}");
        assert_eq!(said(None, 4, |x, y| (x - 449.5, y - 299.5)), None, "the extent has its own centre");
    }

    #[test]
    fn coordinates_without_pixels_are_noticed() {
        for size in [None, Some(SIZE)] {
            for (unit, from) in [(900.0, 0.0), (900.0, 450.0), (700.0, 450.0)] {
                let told = said(size, 4, |x, y| ((x - from) / unit, (y - from) / unit)).expect("normalised");
                assert!(told.contains("these are no pixels. Multiply"), "{told}");
            }
        }
    }

    #[test]
    fn nothing_is_said_of_what_images_show() {
        assert_eq!(of_size(900, 600), None);
        assert_eq!(of_size(1500, 1000), None, "an object off the middle");
        assert_eq!(said(Some(SIZE), 1, |x, y| (x / 4.0, y / 4.0)), None, "few points");
        assert_eq!(said(Some(SIZE), 1, |x, y| (x / 900.0, y / 900.0)), None, "few points");
        let circle = |x: f64, y: f64| (450.0 + (x - 450.0) / 4.0, 300.0 + (y - 300.0) / 4.0);
        assert_eq!(said(Some(SIZE), 4, circle), None, "a fisheye's circle");
        assert_eq!(said(Some(SIZE), 4, |x, y| (1.6 * x - 270.0, 1.6 * y - 180.0)), None, "a scene that was made up");
        assert_eq!(said(None, 4, |x, y| (x, y)), None);
    }
}
