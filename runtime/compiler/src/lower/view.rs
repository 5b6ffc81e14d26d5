//! Strided views on buffers and weights.

/// Memory that a view points into.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Base {
    /// A buffer of the arena.
    Buffer(usize),
    /// Weights of the image.
    Weights,
}

/// Strided view of a value: element `[i, j, ..]` at
/// `offset + i * strides[0] + j * strides[1] + ..`.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct View {
    base: Base,
    /// Offset from the first element of the buffer or of the weights.
    pub offset: usize,
    pub strides: Vec<usize>,
}

impl View {
    pub fn contiguous(buffer: usize, offset: usize, shape: &[usize]) -> Self {
        Self {
            base: Base::Buffer(buffer),
            offset,
            strides: crate::tensor::strides(shape),
        }
    }

    pub fn weights(offset: usize, shape: &[usize]) -> Self {
        Self {
            base: Base::Weights,
            offset,
            strides: crate::tensor::strides(shape),
        }
    }

    /// Returns the buffer, unless the view is in the weights.
    pub fn buffer(&self) -> Option<usize> {
        match self.base {
            Base::Buffer(buffer) => Some(buffer),
            Base::Weights => None,
        }
    }

    /// Returns a view on the same memory with other offset and strides.
    pub fn with(&self, offset: usize, strides: Vec<usize>) -> Self {
        Self {
            base: self.base,
            offset,
            strides,
        }
    }

    pub fn is_contiguous(&self, shape: &[usize]) -> bool {
        let own = crate::tensor::strides(shape);
        (0..shape.len()).all(|i| shape[i] == 1 || self.strides[i] == own[i])
    }

    /// Returns whether no two elements share a place, as those of a broadcast do.
    pub fn is_injective(&self, shape: &[usize]) -> bool {
        let mut axes: Vec<_> = self
            .strides
            .iter()
            .zip(shape)
            .filter(|(_, len)| **len > 1)
            .collect();
        axes.sort_unstable();
        let mut reach = 1;
        axes.into_iter().all(|(&stride, &len)| {
            let apart = stride >= reach;
            reach += stride * (len - 1);
            apart
        })
    }

    /// Returns the number of elements that the view spans, gaps included.
    pub fn reach(&self, shape: &[usize]) -> usize {
        1 + shape
            .iter()
            .zip(&self.strides)
            .map(|(dim, stride)| (dim - 1) * stride)
            .sum::<usize>()
    }

    /// Returns the strides with which a value of another shape reads this one: 0 where it
    /// broadcasts.
    pub fn broadcast(&self, from: &[usize], to: &[usize]) -> Vec<usize> {
        let missing = to.len() - from.len();
        (0..to.len())
            .map(|i| {
                i.checked_sub(missing)
                    .map_or(0, |i| if from[i] == 1 { 0 } else { self.strides[i] })
            })
            .collect()
    }

    /// Returns the strides after a reshape, if it needs no copy: each group of axes with equal
    /// volume must have one stride.
    pub fn reshaped(&self, from: &[usize], to: &[usize]) -> Option<Vec<usize>> {
        let kept: Vec<(usize, usize)> = from
            .iter()
            .copied()
            .zip(self.strides.iter().copied())
            .filter(|&(dim, _)| dim != 1)
            .collect();
        let mut strides = vec![1; to.len()];
        let (mut i, mut j) = (0, 0);
        while i < kept.len() {
            // The smallest groups of old axes `i..i_end` and new axes `j..j_end` with the same number of elements.
            let (mut old, mut new) = (kept[i].0, 1);
            let (mut i_end, mut j_end) = (i + 1, j);
            while old != new {
                if new < old {
                    new *= to.get(j_end)?;
                    j_end += 1;
                } else {
                    old *= kept.get(i_end)?.0;
                    i_end += 1;
                }
            }
            if kept[i..i_end]
                .windows(2)
                .any(|pair| pair[0].1 != pair[1].1 * pair[1].0)
            {
                return None;
            }
            let mut stride = kept[i_end - 1].1;
            for axis in (j..j_end).rev() {
                strides[axis] = stride;
                stride *= to[axis];
            }
            (i, j) = (i_end, j_end);
        }
        Some(strides)
    }
}

/// Brings several strided operands over one shape to four dimensions: axes of length one are
/// removed, neighbours with one stride in every operand are merged. Returns `None` if more than
/// four remain.
pub(super) fn four<const N: usize>(
    shape: &[usize],
    strides: [&[usize]; N],
) -> Option<([u32; 4], [[u32; 4]; N])> {
    let mut axes: Vec<(usize, [usize; N])> = vec![];
    for (i, &dim) in shape.iter().enumerate() {
        if dim == 1 {
            continue;
        }
        let own: [usize; N] = strides.map(|strides| strides[i]);
        match axes.last_mut() {
            Some((len, outer))
                if outer
                    .iter()
                    .zip(own)
                    .all(|(&outer, own)| outer == own * dim) =>
            {
                *len *= dim;
                *outer = own;
            }
            _ => axes.push((dim, own)),
        }
    }
    let start = 4usize.checked_sub(axes.len())?;
    let mut dims = [1; 4];
    let mut out = [[0; 4]; N];
    for (i, (dim, own)) in axes.into_iter().enumerate() {
        dims[start + i] = dim as u32;
        for (out, own) in out.iter_mut().zip(own) {
            out[start + i] = own as u32;
        }
    }
    Some((dims, out))
}
