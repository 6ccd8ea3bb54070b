// Real spherical harmonics up to degree 4 in the sign convention of 3DGS, and their derivatives.
#pragma once

#include "math/vec.hpp"

namespace dyngs {

inline constexpr int kMaxShTerms = 25;

// basis[k] for k < (degree + 1)^2 at the unit direction (x, y, z).
template <class R>
DYNGS_HD void sh_basis(int degree, R x, R y, R z, R* basis) {
  const auto c = [](double value) { return real<R>(value); };
  basis[0] = c(0.28209479177387814);
  if (degree < 1) return;
  basis[1] = c(-0.4886025119029199) * y;
  basis[2] = c(0.4886025119029199) * z;
  basis[3] = c(-0.4886025119029199) * x;
  if (degree < 2) return;
  const R xx = x * x, yy = y * y, zz = z * z, xy = x * y, yz = y * z, xz = x * z;
  basis[4] = c(1.0925484305920792) * xy;
  basis[5] = c(-1.0925484305920792) * yz;
  basis[6] = c(0.31539156525252005) * (zz + zz - xx - yy);
  basis[7] = c(-1.0925484305920792) * xz;
  basis[8] = c(0.5462742152960396) * (xx - yy);
  if (degree < 3) return;
  const R three = c(3), four = c(4), seven = c(7);
  basis[9] = c(-0.5900435899266435) * y * (three * xx - yy);
  basis[10] = c(2.890611442640554) * xy * z;
  basis[11] = c(-0.4570457994644658) * y * (four * zz - xx - yy);
  basis[12] = c(0.3731763325901154) * z * (zz + zz - three * xx - three * yy);
  basis[13] = c(-0.4570457994644658) * x * (four * zz - xx - yy);
  basis[14] = c(1.445305721320277) * z * (xx - yy);
  basis[15] = c(-0.5900435899266435) * x * (xx - three * yy);
  if (degree < 4) return;
  basis[16] = c(2.5033429417967046) * xy * (xx - yy);
  basis[17] = c(-1.7701307697799304) * yz * (three * xx - yy);
  basis[18] = c(0.9461746957575601) * xy * (seven * zz - c(1));
  basis[19] = c(-0.6690465435572892) * yz * (seven * zz - three);
  basis[20] = c(0.10578554691520431) * (zz * (c(35) * zz - c(30)) + three);
  basis[21] = c(-0.6690465435572892) * xz * (seven * zz - three);
  basis[22] = c(0.47308734787878004) * (xx - yy) * (seven * zz - c(1));
  basis[23] = c(-1.7701307697799304) * xz * (xx - three * yy);
  basis[24] = c(0.6258357354491761) * (xx * (xx - three * yy) - yy * (three * xx - yy));
}

// Sum over k of g[k] times the gradient of basis[k] with respect to (x, y, z), the polynomials taken as they stand.
template <class R>
DYNGS_HD void sh_basis_vjp(int degree, R x, R y, R z, const R* g, R& gx, R& gy, R& gz) {
  const auto c = [](double value) { return real<R>(value); };
  gx = gy = gz = c(0);
  if (degree < 1) return;
  gy += c(-0.4886025119029199) * g[1];
  gz += c(0.4886025119029199) * g[2];
  gx += c(-0.4886025119029199) * g[3];
  if (degree < 2) return;
  const R two = c(2), three = c(3), four = c(4), six = c(6), seven = c(7), eight = c(8);
  R t = c(1.0925484305920792) * g[4];
  gx += t * y, gy += t * x;
  t = c(-1.0925484305920792) * g[5];
  gy += t * z, gz += t * y;
  t = c(0.31539156525252005) * g[6];
  gx -= two * t * x, gy -= two * t * y, gz += four * t * z;
  t = c(-1.0925484305920792) * g[7];
  gx += t * z, gz += t * x;
  t = c(0.5462742152960396) * g[8];
  gx += two * t * x, gy -= two * t * y;
  if (degree < 3) return;
  const R xx = x * x, yy = y * y, zz = z * z, xy = x * y, yz = y * z, xz = x * z;
  t = c(-0.5900435899266435) * g[9];
  gx += six * t * xy, gy += three * t * (xx - yy);
  t = c(2.890611442640554) * g[10];
  gx += t * yz, gy += t * xz, gz += t * xy;
  t = c(-0.4570457994644658) * g[11];
  gx -= two * t * xy, gy += t * (four * zz - xx - three * yy), gz += eight * t * yz;
  t = c(0.3731763325901154) * g[12];
  gx -= six * t * xz, gy -= six * t * yz, gz += t * (six * zz - three * xx - three * yy);
  t = c(-0.4570457994644658) * g[13];
  gx += t * (four * zz - three * xx - yy), gy -= two * t * xy, gz += eight * t * xz;
  t = c(1.445305721320277) * g[14];
  gx += two * t * xz, gy -= two * t * yz, gz += t * (xx - yy);
  t = c(-0.5900435899266435) * g[15];
  gx += three * t * (xx - yy), gy -= six * t * xy;
  if (degree < 4) return;
  t = c(2.5033429417967046) * g[16];
  gx += t * y * (three * xx - yy), gy += t * x * (xx - three * yy);
  t = c(-1.7701307697799304) * g[17];
  gx += six * t * x * yz, gy += three * t * z * (xx - yy), gz += t * y * (three * xx - yy);
  t = c(0.9461746957575601) * g[18];
  gx += t * y * (seven * zz - c(1)), gy += t * x * (seven * zz - c(1)), gz += c(14) * t * x * yz;
  t = c(-0.6690465435572892) * g[19];
  gy += t * z * (seven * zz - three), gz += t * y * (c(21) * zz - three);
  t = c(0.10578554691520431) * g[20];
  gz += t * z * (c(140) * zz - c(60));
  t = c(-0.6690465435572892) * g[21];
  gx += t * z * (seven * zz - three), gz += t * x * (c(21) * zz - three);
  t = c(0.47308734787878004) * g[22];
  gx += two * t * x * (seven * zz - c(1)), gy -= two * t * y * (seven * zz - c(1)), gz += c(14) * t * z * (xx - yy);
  t = c(-1.7701307697799304) * g[23];
  gx += three * t * z * (xx - yy), gy -= six * t * y * xz, gz += t * x * (xx - three * yy);
  t = c(0.6258357354491761) * g[24];
  gx += four * t * x * (xx - three * yy), gy += four * t * y * (yy - three * xx);
}

}  // namespace dyngs
