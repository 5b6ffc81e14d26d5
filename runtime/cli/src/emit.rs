//! Writes program images as source: a constant, aligned byte array that a compiler puts into flash,
//! so that opening copies nothing.
//!
//! The name in the source is made from the name of the file.

use std::fmt::Write;
use std::path::Path;

use crate::refusal::Refusal;

/// Alignment of the array in bytes: that of the weights in the image.
const ALIGN: usize = lads_image::format::WEIGHTS_ALIGN;

/// Number of bytes of the image in a line of source.
const BYTES_PER_LINE: usize = 32;

/// Formats the image as a C file, for C99 with GNU attributes, C11, and C++.
pub fn c(image: &[u8], path: &Path) -> Result<String, Refusal> {
    let name = identifier(path)?;
    let len = image.len();
    let mut source = format!(
        "/* A program image of lads; made by `lads compile --emit-c`. Declare it where it is used:\n\
         \x20*     extern const unsigned char {name}[{len}];\n\
         \x20* and open it with lads_policy_open({name}, {len}, &policy). */\n\
         #if defined(__cplusplus)\n\
         extern \"C\" alignas({ALIGN}) const unsigned char {name}[{len}];\n\
         alignas({ALIGN})\n\
         #elif defined(__GNUC__)\n\
         extern const unsigned char {name}[{len}];\n\
         __attribute__((aligned({ALIGN})))\n\
         #else\n\
         extern const unsigned char {name}[{len}];\n\
         _Alignas({ALIGN})\n\
         #endif\n\
         const unsigned char {name}[{len}] = {{\n"
    );
    for line in image.chunks(BYTES_PER_LINE) {
        for byte in line {
            let _ = write!(source, "{byte},");
        }
        source.push('\n');
    }
    source.push_str("};\n");
    Ok(source)
}

/// Formats the image as a Rust file, to be included as a module.
pub fn rust(image: &[u8], path: &Path) -> Result<String, Refusal> {
    let name = identifier(path)?.to_uppercase();
    let len = image.len();
    let mut source = format!(
        "//! A program image of lads; made by `lads compile --emit-rust`. Open it with `Policy::new_checked(&{name}.0)`.\n\n\
         /// The image, aligned as its weights are.\n\
         #[repr(C, align({ALIGN}))]\n\
         pub struct Image(pub [u8; {len}]);\n\n\
         /// {len} bytes, constant: they stay where the linker puts them.\n\
         pub static {name}: Image = Image(*b\"\\\n"
    );
    for line in image.chunks(BYTES_PER_LINE) {
        for byte in line {
            let _ = write!(source, "\\x{byte:02x}");
        }
        source.push_str("\\\n");
    }
    source.push_str("\");\n");
    Ok(source)
}

/// Makes a name that C and Rust accept from the stem of the file.
fn identifier(path: &Path) -> Result<String, Refusal> {
    let stem = path.file_stem().unwrap_or_default().to_string_lossy();
    let plain = |c: char| {
        if c.is_ascii_alphanumeric() {
            c.to_ascii_lowercase()
        } else {
            '_'
        }
    };
    let name: String = stem.chars().map(plain).collect();
    if name.starts_with(|c: char| c.is_ascii_lowercase()) {
        Ok(name + "_image")
    } else {
        Err(Refusal::new(
            path.display(),
            "its name cannot become that of an array",
            "let it start with a letter",
        ))
    }
}
