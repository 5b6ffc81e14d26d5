//! A picture to draw into: red, green and blue bytes, rows from the top. What can fail: nothing; what lies outside is not drawn.

use std::convert::Infallible;

use embedded_graphics::Pixel;
use embedded_graphics::draw_target::DrawTarget;
use embedded_graphics::geometry::{OriginDimensions, Size};
use embedded_graphics::pixelcolor::{Rgb888, RgbColor as _};

/// A picture of red, green and blue bytes.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Canvas {
    width: u32,
    height: u32,
    rgb: Vec<u8>,
}

impl Canvas {
    /// Makes a black picture.
    pub fn new(width: u32, height: u32) -> Self {
        let rgb = vec![0; 3 * width as usize * height as usize];
        Self { width, height, rgb }
    }

    /// Width and height of the picture in pixels.
    pub fn size(&self) -> [u32; 2] {
        [self.width, self.height]
    }

    /// Bytes of the picture, three per pixel.
    pub fn rgb(&self) -> &[u8] {
        &self.rgb
    }

    /// Returns the pixel in column `x` and row `y` as the number `0xRRGGBB`; black outside.
    pub fn pixel(&self, x: u32, y: u32) -> u32 {
        let start = 3 * (y as usize * self.width as usize + x as usize);
        match self.rgb.get(start..start + 3) {
            Some(&[r, g, b]) if x < self.width => u32::from_be_bytes([0, r, g, b]),
            _ => 0,
        }
    }

    /// Makes the picture black.
    pub fn clear(&mut self) {
        self.rgb.fill(0);
    }

    /// Copies a picture of `width` pixels per row into this one, with its upper left corner at (`left`, `top`).
    pub fn paste(&mut self, rgb: &[u8], width: u32, left: u32, top: u32) {
        let row_len = 3 * self.width as usize;
        let rows = self.rgb.chunks_exact_mut(row_len).skip(top as usize);
        for (row, source) in rows.zip(rgb.chunks_exact(3 * width as usize)) {
            let inside = row.iter_mut().skip(3 * left as usize);
            for (to, from) in inside.zip(source) {
                *to = *from;
            }
        }
    }
}

impl OriginDimensions for Canvas {
    fn size(&self) -> Size {
        Size::new(self.width, self.height)
    }
}

impl DrawTarget for Canvas {
    type Color = Rgb888;
    type Error = Infallible;

    fn draw_iter<I>(&mut self, pixels: I) -> Result<(), Infallible>
    where
        I: IntoIterator<Item = Pixel<Rgb888>>,
    {
        for Pixel(at, color) in pixels {
            let (Ok(x), Ok(y)) = (u32::try_from(at.x), u32::try_from(at.y)) else {
                continue;
            };
            if x >= self.width {
                continue;
            }
            let start = 3 * (y as usize * self.width as usize + x as usize);
            if let Some(pixel) = self.rgb.get_mut(start..start + 3) {
                pixel.copy_from_slice(&[color.r(), color.g(), color.b()]);
            }
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use embedded_graphics::Drawable as _;
    use embedded_graphics::geometry::Point;
    use embedded_graphics::primitives::{Primitive as _, PrimitiveStyle, Rectangle};

    use super::*;

    #[test]
    fn what_lies_outside_is_not_drawn() {
        let mut canvas = Canvas::new(4, 3);
        canvas.paste(&[9; 3 * 3 * 5], 3, 2, 1);
        let row = |canvas: &Canvas, y: usize| canvas.rgb()[12 * y..12 * (y + 1)].to_vec();
        assert_eq!(row(&canvas, 0), [0; 12]);
        assert_eq!(row(&canvas, 1), [0, 0, 0, 0, 0, 0, 9, 9, 9, 9, 9, 9]);
        let style = PrimitiveStyle::with_fill(Rgb888::new(1, 2, 3));
        let square = Rectangle::new(Point::new(-2, 2), Size::new(3, 9));
        square.into_styled(style).draw(&mut canvas).unwrap();
        assert_eq!(row(&canvas, 2), [1, 2, 3, 0, 0, 0, 9, 9, 9, 9, 9, 9]);
    }
}
