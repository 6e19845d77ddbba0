use std::fs;
use std::io::Cursor;

use super::*;
use crate::formats::colmap::{ColmapImage, write};
use crate::formats::metric::Model;
use crate::formats::{Label, fixture, mutation};

/// A solved scene as a model's files, and the input that it came from.
fn exported() -> (LabelledInput, [Vec<u8>; 3], [String; 3]) {
    let (mut input, solution) = fixture::solved();
    // As COLMAP names them; the ids descend, so that positions and ids differ.
    input.view_labels = (0..5).map(|view| Label::Name(format!("image {view}.jpg").into())).collect();
    input.colmap_images = (0..5).map(|view| ColmapImage { id: 9 - view, ..ColmapImage::default() }).collect();
    input.raw.views.iter_mut().for_each(|view| view.camera_group = 4);
    let model = Model::of_parts(&solution, &input).expect("a metric result").remove(0);
    (input, write::binary(&model), write::text(&model))
}

fn write_model(directory: &Path, kind: &str, files: [&[u8]; 2]) {
    for (name, bytes) in ["cameras", "images"].into_iter().zip(files) {
        fs::write(directory.join(format!("{name}.{kind}")), bytes).expect("written");
    }
}

/// What a model of these files says.
fn parsed(kind: &str, files: [&[u8]; 2]) -> Result<LabelledInput, String> {
    let mut images = Images::default();
    let limits = Limits::default();
    let names = [format!("cameras.{kind}"), format!("images.{kind}")];
    let read = |images: &mut Images| {
        let [cameras, of_images] = files.map(Cursor::new);
        let lengths = files.map(|file| Some(file.len() as u64));
        if kind == "bin" {
            binary::cameras(cameras, &names[0], lengths[0], images)?;
            binary::images(of_images, &names[1], lengths[1], &limits, images)
        } else {
            text::cameras(cameras, &names[0], images)?;
            text::images(of_images, &names[1], &limits, images)
        }
    };
    let observations = read(&mut images).map_err(|error| error.to_string())?;
    into_labelled(images, observations, Path::new(&names[1]), &limits).map_err(|error| error.to_string())
}

#[test]
fn what_is_written_comes_back_from_text_and_binary() {
    let (input, bytes, texts) = exported();
    let directory = tempfile::tempdir().expect("a temporary directory");
    let directory = directory.path();
    write_model(directory, "txt", [texts[0].as_bytes(), texts[1].as_bytes()]);
    let from_text = read(directory, &Limits::default()).expect("a valid model");
    write_model(directory, "bin", [&bytes[0], &bytes[1]]);
    let from_binary = read(directory, &Limits::default()).expect("a valid model");
    assert_eq!((from_text.lines.len(), from_binary.lines.len()), (100, 0));
    let solution = fixture::solved().1;
    for back in [from_text, from_binary] {
        assert_eq!(back.view_labels, input.view_labels);
        let ids = |input: &LabelledInput| input.colmap_images.iter().map(|image| image.id).collect::<Vec<_>>();
        assert_eq!(ids(&back), ids(&input));
        assert_eq!(back.raw.views, input.raw.views);
        // The wrong tracks have no point, so they are not among the model's.
        let kept = |k: &usize| solution.observations.inlier[*k];
        let wanted: Vec<(u32, Label, f64, f64)> = (0..input.raw.x.len())
            .filter(kept)
            .map(|k| {
                let track = input.track_labels[input.raw.track[k] as usize].clone();
                (input.raw.view[k], track, input.raw.x[k], input.raw.y[k])
            })
            .collect();
        assert_eq!((back.raw.x.len(), back.notes.len()), (wanted.len(), 0));
        for (k, (view, track, x, y)) in wanted.into_iter().enumerate() {
            assert_eq!((back.raw.view[k], &back.track_labels[back.raw.track[k] as usize]), (view, &track));
            // Half a pixel was added and taken away.
            assert!((back.raw.x[k] - x).abs() < 1e-12 && (back.raw.y[k] - y).abs() < 1e-12);
        }
    }
}

const CAMERAS: &str = "# a comment\n1 SIMPLE_PINHOLE 640 480 500 320 240\n";
const IMAGES: &str =
    "1 1 0 0 0 0 0 0 1 a b.jpg\n10.5 20.5 7 1 2 -1\n2 1 0 0 0 0 0 0 1 c.jpg\n12.5 20.5 7\n3 1 0 0 0 0 0 0 1 d.jpg\n\n";

#[test]
fn text_may_have_comments_names_with_blanks_and_images_without_keypoints() {
    let input = parsed("txt", [CAMERAS.as_bytes(), IMAGES.as_bytes()]).expect("valid");
    let names: Vec<String> = input.view_labels.iter().map(Label::to_string).collect();
    assert_eq!(names, ["a b.jpg", "c.jpg", "d.jpg"]);
    assert_eq!((&input.raw.x[..], &input.raw.y[..]), (&[10.0, 12.0][..], &[20.0, 20.0][..]));
    assert_eq!((&input.lines[..], &input.track_labels[..]), (&[2, 4][..], &[Label::Number(7)][..]));
}

#[test]
fn what_is_wrong_with_text_is_named_by_line() {
    let cameras = |text: &str| parsed("txt", [text.as_bytes(), IMAGES.as_bytes()]).expect_err("bad cameras");
    let images = |text: &str| parsed("txt", [CAMERAS.as_bytes(), text.as_bytes()]).expect_err("bad images");
    assert!(cameras("1 PINHOLE 6 4 1 2\n").starts_with("cameras.txt, line 1: 2 parameters where PINHOLE has 4"));
    assert!(cameras("1 MAGIC 6 4 1\n").starts_with("cameras.txt, line 1: `MAGIC` is not one"));
    assert!(cameras("1 SIMPLE_PINHOLE 0 4 1 2 3\n").contains("line 1: size 0 x 4 px"));
    assert!(cameras(&CAMERAS.repeat(2)).starts_with("cameras.txt, line 4: camera 1: is there a second time"));
    assert!(images("1 1 0 0 0 0 0 0 5 a\n\n").contains("line 1: image 1: is of camera 5"));
    assert!(images("1 1 0 0 0\n\n").starts_with("images.txt, line 1: pose: is empty"));
    assert!(images("1 1 0 0 0 0 0 0 1 a\n1 2\n").contains("line 2: image 1: keypoint 0 has no `X Y POINT`"));
    assert!(images("1 1 0 0 0 0 0 0 1 a").contains("line 1: image 1: has no line of keypoints"));
    assert!(images(&IMAGES.replace("2 1 0", "1 1 0")).contains("line 3: image 1: is there a second time"));
    assert!(images("").contains("images.txt: has 0 images"));
    assert!(images(&IMAGES.replace("12.5", "nan")).starts_with("images.txt, line 4: x: NaN is not a finite"));
}

#[test]
fn what_is_wrong_with_bytes_is_named_by_offset() {
    let (_, [cameras, images, _], _) = exported();
    let bad = |cameras: &[u8], images: &[u8]| parsed("bin", [cameras, images]).expect_err("bad files");
    assert_eq!(bad(&cameras[..40], &images), "cameras.bin, byte 40: camera 4: the file ends here; it may be truncated");
    assert!(bad(&[], &images).starts_with("cameras.bin, byte 0: the count of cameras: the file ends here"));
    let mut model = cameras.clone();
    model[12] = 99;
    assert!(bad(&model, &images).starts_with("cameras.bin, byte 12: camera 4: model 99 is not one"));
    // The count of the first image's keypoints stands behind its name.
    let place = 8 + 64 + "image 0.jpg".len() + 1;
    let mut hostile = images.clone();
    hostile[place..place + 8].fill(0xFF);
    let words = bad(&cameras, &hostile);
    let wanted =
        format!("images.bin, byte {place}: image 9: {} keypoints are announced, the file has room for", u64::MAX);
    assert!(words.starts_with(&wanted), "{words}");
    let torn = images.len() - 1;
    assert!(bad(&cameras, &images[..torn]).contains("keypoints are announced"), "{}", bad(&cameras, &images[..torn]));
    let longer = [&images[..], &[0]].concat();
    assert!(bad(&cameras, &longer).ends_with("the file goes on after its last record"));
    let mut odd = images.clone();
    let inlier = fixture::solved().1.tracks.inlier.iter().position(|&inlier| inlier).expect("an inlier");
    let place = place + 8 + 24 * inlier;
    odd[place..place + 8].copy_from_slice(&f64::NAN.to_le_bytes());
    let words = bad(&cameras, &odd);
    assert!(words.starts_with("images.bin: view image 0.jpg, track 1"), "{words}");
}

#[test]
fn limits_hold_while_reading() {
    let (_, [cameras, images, _], texts) = exported();
    let limits = Limits { max_views: 3, max_observations: 10, ..Limits::default() };
    let of_binary = |limits: &Limits| {
        let mut found = Images::default();
        binary::cameras(&cameras[..], "c", None, &mut found).expect("valid");
        binary::images(&images[..], "i", None, limits, &mut found).expect_err("above the limits").to_string()
    };
    assert!(of_binary(&limits).contains("more observations than the limit of 10"));
    assert!(of_binary(&Limits { max_views: 3, ..Limits::default() }).contains("more images than the limit of 3"));
    let mut found = Images::default();
    text::cameras(texts[0].as_bytes(), "c", &mut found).expect("valid");
    let refused = text::images(texts[1].as_bytes(), "i", &limits, &mut found).expect_err("above the limits");
    assert!(refused.to_string().contains("line 4: image 9: more observations than the limit of 10"), "{refused}");
}

#[test]
fn no_mutation_of_bytes_makes_the_reader_panic() {
    let (_, [cameras, images, _], _) = exported();
    let small = |bytes: &[u8]| parsed("bin", [&cameras, bytes]).map(|_| ());
    // The first image and a half, so that most mutations hit names and counts rather than coordinates.
    let seeds = [images.clone(), images[..8 + 64 + 12 + 8 + 40 * 24 + 100].to_vec()];
    assert!(mutation::survives(&seeds, small) > 0, "every mutated file was refused");
    let accepted =
        mutation::survives(std::slice::from_ref(&cameras), |bytes| parsed("bin", [bytes, &images]).map(|_| ()));
    assert!(accepted > 0, "every mutated file was refused");
}

#[test]
fn no_mutation_of_text_makes_the_reader_panic() {
    let seeds = [IMAGES.as_bytes().to_vec()];
    let accepted = mutation::survives(&seeds, |bytes| parsed("txt", [CAMERAS.as_bytes(), bytes]).map(|_| ()));
    assert!(accepted > 0, "every mutated file was refused");
    let seeds = [CAMERAS.as_bytes().to_vec()];
    let accepted = mutation::survives(&seeds, |bytes| parsed("txt", [bytes, IMAGES.as_bytes()]).map(|_| ()));
    assert!(accepted > 0, "every mutated file was refused");
}
