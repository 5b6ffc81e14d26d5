//! Frames of cameras as PNG files, which lose nothing. What can fail: a file that is none, or has other samples than three bytes a pixel.

use std::io::Cursor;

/// Encodes the bytes of `rows` by `columns` pixels.
pub fn encode(pixels: &[u8], [rows, columns]: [u32; 2]) -> Result<Vec<u8>, String> {
    let mut bytes = Vec::new();
    let mut encoder = png::Encoder::new(&mut bytes, columns, rows);
    encoder.set_color(png::ColorType::Rgb);
    encoder.set_depth(png::BitDepth::Eight);
    let written = encoder
        .write_header()
        .and_then(|mut writer| writer.write_image_data(pixels));
    written.map_err(|error| error.to_string())?;
    Ok(bytes)
}

/// Decodes a file of [`encode`]: the pixels, and rows and columns.
pub fn decode(file: &[u8]) -> Result<(Vec<u8>, [u32; 2]), String> {
    let mut reader = png::Decoder::new(Cursor::new(file))
        .read_info()
        .map_err(|error| error.to_string())?;
    let (colour, depth) = reader.output_color_type();
    if (colour, depth) != (png::ColorType::Rgb, png::BitDepth::Eight) {
        return Err(format!("its pixels are {colour:?} of {depth:?} bits"));
    }
    let mut pixels = vec![0; reader.output_buffer_size().ok_or("it is too large")?];
    let info = reader
        .next_frame(&mut pixels)
        .map_err(|error| error.to_string())?;
    pixels.truncate(info.buffer_size());
    Ok((pixels, [info.height, info.width]))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_frame_survives_its_file_and_what_is_none_is_refused() {
        let pixels: Vec<u8> = (0..2 * 5 * 3).map(|i| (i * 37 % 251) as u8).collect();
        let file = encode(&pixels, [2, 5]).unwrap();
        assert_eq!(decode(&file).unwrap(), (pixels.clone(), [2, 5]));
        assert!(encode(&pixels[1..], [2, 5]).is_err());
        assert!(decode(&file[..file.len() / 2]).is_err());
        assert!(decode(b"no picture").is_err());
    }
}
